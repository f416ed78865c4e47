"""Which calibration runs to fly next: see :func:`~magbridge.calibration.planning.plan.plan`."""
