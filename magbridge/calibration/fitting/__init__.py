"""Fit a calibration to logs; start at :func:`~magbridge.calibration.fitting.fit.fit`."""
