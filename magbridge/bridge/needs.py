"""What a calibration needs of the link, compared with what the configuration will provide."""

from __future__ import annotations

from magbridge.calibration.model import Calibration
from magbridge.columns import may_be
from magbridge.config import Config
from magbridge.correction import TEMPERATURE
from magbridge.errors import ConfigError

__all__ = ["check", "unmet"]


def check(calibration: Calibration, config: Config) -> None:
    """Check that the link will provide what the calibration needs.

    ConfigError: a parameter that ``[telemetry]`` lacks, or that comes in another unit.
    """
    for error in unmet(calibration, config):
        raise error


def unmet(calibration: Calibration, config: Config) -> list[ConfigError]:
    """Return what the calibration needs and the link will not provide: each as :func:`check` raises it."""
    units, errors = calibration.units, []
    for name in calibration.channels:
        if name == TEMPERATURE:
            continue
        if name not in config.telemetry:
            missing = "missing: the calibration needs this parameter"
            errors.append(ConfigError(config.path, f"telemetry.{name}", missing))
            continue
        unit = config.telemetry[name].unit
        if not may_be(unit, units.get(name, "")):
            expected = f"expected {units[name]!r}, the calibration's unit, not {unit!r}"
            errors.append(ConfigError(config.path, f"telemetry.{name}.unit", expected))
    return errors
