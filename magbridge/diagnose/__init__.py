"""Diagnose errors of the forward model: find their physical causes, and measure the gain of a correction.

:func:`~magbridge.diagnose.run.diagnose` is the entry point; start reading there. The package uses the
calibration and the estimation library, and must not depend on the bridge or on other applications.

1. :mod:`.survey` reads deployments. :mod:`.problem` linearises the difference of measured and predicted field
   in every coefficient of a calibration.
2. Each of the :mod:`.causes` proposes candidates on a grid of its nonlinear parameters. A candidate is a set
   of :mod:`.columns` of the linear problem.
3. :mod:`.joint` fits calibration, effects and :mod:`.noise` together. :mod:`.evidence` tests one candidate,
   and :mod:`.state` all candidates in a round. :mod:`.search` adds one cause after the other and exchanges
   causes for their competing hypotheses.
4. :mod:`.leftover` fits free functions (:mod:`.descriptions`, :mod:`.packets`) to the signal. A cause is
   named only if it is likelier than these.
5. :mod:`.extend` adds the named causes to a calibration. :mod:`.improvement` corrects held-out dives with the
   extended calibration.
6. :mod:`.diagnosis` holds the result, :mod:`.assessment` decides whether the extended calibration is usable,
   and :mod:`.report` writes the page and ``findings.json``.
"""
