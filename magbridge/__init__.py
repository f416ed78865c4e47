"""magbridge: a magnetometer bridge for vehicles whose own iron moves."""

__version__ = "0.1.0"
