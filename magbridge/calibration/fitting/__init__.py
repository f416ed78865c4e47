"""From logs of calibration runs to a calibration; :func:`~magbridge.calibration.fitting.fit.fit` does it."""
