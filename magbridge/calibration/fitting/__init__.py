"""Fit a calibration to logs.

:func:`~.observe.observations` converts the columns of a log to :class:`~.observations.Observations`.
:func:`~.fit.fit` fits them by one of the :mod:`.methods` (for a known field) or by :mod:`.in_place` (for a
survey, together with the crustal field below its track). :func:`~.checks.judged` adds the boresight and
warnings about undetermined quantities. Start reading at :func:`~.fit.fit`, then at :mod:`.solve`, the loop of
every fit. The package depends on the model and on :mod:`magbridge.estimation`, but not on log formats,
MAVLink or the live bridge.
"""

FIT_RANGES = {"order": (1, 6), "site_bias": (0.0, 1e5), "position_sigma": (0.0, 1e5)}
"""Option of :func:`.fit.fit` -> its smallest and largest value; biases in nT, positions in m."""
