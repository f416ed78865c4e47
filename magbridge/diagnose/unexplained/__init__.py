"""What is left beside the named causes, described without a name.

:mod:`.leftover` weighs the descriptions that :mod:`.descriptions` lists. They are made of :mod:`.shapes`, of
a source that passes (:mod:`.passage`), of oscillations that last a while (:mod:`.packets`), and of named
causes that do not keep their size (:mod:`.varying`).
"""
