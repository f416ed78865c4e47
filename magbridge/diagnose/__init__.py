"""Diagnose errors of the forward model: their physical causes, and the improvement of correcting them.

:func:`~magbridge.diagnose.run.diagnose` is the entry point; start reading there. The package uses the
calibration and the estimation library, and must not depend on the bridge or on other applications.

1. :mod:`.survey` reads deployments, and :mod:`.problem` compares them with a calibration: the measured less
   the predicted field, linear in every coefficient.
2. :mod:`.causes` put forward their candidates: :mod:`.columns` of that problem, at a grid of nonlinear
   parameters.
3. :mod:`.joint` fits calibration, effects and :mod:`.noise` together. :mod:`.evidence` weighs one candidate,
   :mod:`.state` all of them in a round, and :mod:`.search` adds cause after cause and exchanges them for
   their competing hypotheses.
4. :mod:`.leftover` describes the remaining signal, or all of it, without a name, by :mod:`.descriptions` and
   :mod:`.packets`; names must be likelier.
5. :mod:`.extend` adds the named causes to a calibration; :mod:`.improvement` corrects held-out dives with it.
6. :mod:`.diagnosis` is the result, :mod:`.assessment` decides on its use, and :mod:`.report` writes both for
   people and for programs.
"""
