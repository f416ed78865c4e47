"""Which calibration runs, or which survey, to fly next, from the covariance that they would leave.

Start reading at :func:`~.plan.plan` (runs on all headings at chosen pitch, roll and positions of the masses);
:func:`~.survey_patterns.propose` compares surveys that calibrate themselves. Both linearise the residual
of a fit about a calibration, and fit nothing.
"""
