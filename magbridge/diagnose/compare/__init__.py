"""The comparison of the measured field with the forward model's prediction, as a linear problem.

:mod:`.load_survey` gathers deployments into a :mod:`.survey`, of many :mod:`.dives`. :mod:`.problem`
linearises it about the calibration, whose coefficients stay free (:mod:`.prior`). Every hypothesis adds
:mod:`.design_columns` to that problem.
"""
