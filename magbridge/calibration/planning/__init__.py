"""Plan the next calibration runs or the next survey, from the covariance that they are expected to leave.

:func:`~.plan.plan` chooses runs on all headings, at certain pitch, roll and positions of the masses.
:func:`~.survey_patterns.propose` compares self-calibrating surveys. Both linearise the residual of a fit
about a calibration, and do not fit any data.
"""
