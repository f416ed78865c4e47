"""What is left beside the named causes, described without a name.

:mod:`.leftover` weighs the descriptions that :mod:`.descriptions` lists. They are made of :mod:`.shapes`, of
what lasts for a while (:mod:`.packets`), and of named causes that do not keep their size (:mod:`.varying`).
"""
