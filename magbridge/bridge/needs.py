"""Compare the telemetry that a calibration needs with that of the configuration."""

from __future__ import annotations

from collections.abc import Mapping

from magbridge.calibration.model import Calibration
from magbridge.columns import may_be
from magbridge.config import Config
from magbridge.correction import TEMPERATURE
from magbridge.errors import ConfigError

__all__ = ["check", "check_channels", "unmet"]


def check(calibration: Calibration, config: Config) -> None:
    """Check that the link will provide what the calibration needs.

    ConfigError: a parameter that ``[telemetry]`` lacks, or that comes in another unit.
    """
    for error in unmet(calibration, config):
        raise error


def unmet(calibration: Calibration, config: Config) -> list[ConfigError]:
    """Return an error for each need of the calibration that the link does not provide."""
    units = calibration.units
    return _unmet({name: units.get(name, "") for name in calibration.channels if name != TEMPERATURE}, config)


def check_channels(units: Mapping[str, str], config: Config) -> None:
    """Check that the link will provide telemetry channels in these units; raises as :func:`check`."""
    for error in _unmet(units, config):
        raise error


def _unmet(units: Mapping[str, str], config: Config) -> list[ConfigError]:
    """Return an error for each channel that ``[telemetry]`` lacks or has in another unit."""
    errors = []
    for name, expected_unit in units.items():
        if name not in config.telemetry:
            missing = "missing: the calibration needs this parameter"
            errors.append(ConfigError(config.path, f"telemetry.{name}", missing))
            continue
        unit = config.telemetry[name].unit
        if not may_be(unit, expected_unit):
            expected = f"expected {expected_unit!r}, the calibration's unit, not {unit!r}"
            errors.append(ConfigError(config.path, f"telemetry.{name}.unit", expected))
    return errors
