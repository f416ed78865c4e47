"""The part of a signal that the named causes do not explain, described without a name.

:mod:`.leftover` weighs the descriptions that :mod:`.descriptions` lists. They are made of :mod:`.shapes`, of
transient signals (:mod:`.packets`), and of named causes that change their size (:mod:`.varying`).
"""
