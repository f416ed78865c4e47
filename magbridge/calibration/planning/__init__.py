"""Which calibration runs to fly next: :func:`~magbridge.calibration.planning.plan.plan` is the door."""
