"""Doubt: what the forward model gets wrong, which physical cause it has, and what mending it gains.

:func:`~magbridge.diagnose.run.diagnose` is the door; :data:`~magbridge.diagnose.causes.CAUSES` the table of
causes. It goes through the rooms as a diagnosis does: :mod:`.compare`, :mod:`.causes`, :mod:`.inference`,
:mod:`.extend` and :mod:`.gain`, :mod:`.report`.
"""
