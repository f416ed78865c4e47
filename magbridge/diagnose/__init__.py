"""Doubt: what the forward model gets wrong, which physical cause it has, and what mending it gains.

:func:`~magbridge.diagnose.run.diagnose` is the door, and :mod:`.run` tells the whole of a diagnosis:

1. :mod:`.compare` poses the problem: what was measured less what the forward model predicts, linear in every
   coefficient.
2. :mod:`.causes` put forward their candidates: columns of that problem, at a grid of nonlinear parameters.
3. :mod:`.inference` searches for the candidates that the data support, and for their competing hypotheses.
4. :mod:`.unexplained` describes what is left, or the whole, without a name; :mod:`.accept` weighs names
   against descriptions.
5. :mod:`.extend` makes a calibration of the names; dives left out of the fit measure what that gains.
6. :mod:`.diagnosis` is the result; :mod:`.report` writes it for people and for programs.
"""
