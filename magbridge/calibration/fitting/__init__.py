"""Fit a calibration to logs.

:func:`~.observe.observations` turns the columns of a log into :class:`~.observations.Observations`;
:func:`~.fit.fit` fits them by one of the configurations of :mod:`.methods` (a known field) or by
:mod:`.in_place` (a survey, with the crustal field below its track), and :func:`~.checks.judged` adds what the
data leave open. Start reading at :func:`~.fit.fit`, then :mod:`.solve`, the loop of every fit. The package
knows the model and :mod:`magbridge.estimation`, and no log format, MAVLink or live part.
"""
