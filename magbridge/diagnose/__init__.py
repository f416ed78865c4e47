"""Diagnose errors of the forward model: their physical causes, and the improvement of correcting them.

:func:`~magbridge.diagnose.run.diagnose` is the entry point, and :mod:`.run` has all steps of a diagnosis:

1. :mod:`.compare` sets up the problem: the measured less the predicted field, linear in every
   coefficient.
2. :mod:`.causes` put forward their candidates: columns of that problem, at a grid of nonlinear parameters.
3. :mod:`.inference` searches for the candidates that the data support, and for their competing hypotheses.
4. :mod:`.unexplained` describes the remaining signal, or all of it, without a name; :mod:`.accept` compares
   names with descriptions.
5. :mod:`.extend` adds the named causes to a calibration; held-out dives measure the improvement.
6. :mod:`.diagnosis` is the result; :mod:`.report` writes it for people and for programs.
"""
