"""Online calibration in the bridge: control by parameters, messages about it, and files of its results."""

from __future__ import annotations

from collections import deque
from math import hypot, sqrt
from pathlib import Path
from typing import TYPE_CHECKING

from magbridge.calibration.file import calibration_id, load, save
from magbridge.calibration.model import Calibration, Parameter
from magbridge.config import Config
from magbridge.errors import CalibrationError, ConfigError, WriteError
from magbridge.link.component import Component
from magbridge.link.output import Rate
from magbridge.mavlink.enums import MAG_LEARNING_STATE, MAV_SEVERITY

if TYPE_CHECKING:
    from magbridge.learning import Learner  # imported with [learning] only: the bridge starts sooner

__all__ = ["CALIBRATION_KEYS", "LearningService", "first_calibration", "keep", "kept_path", "open_learner"]

CALIBRATION_KEYS = ("calibration.file", "learning.prior")
ACCEPT, FORGET = 1.0, 2.0
FILE_INTERVAL_US = 600_000_000
"""Shortest time between two files of a learned calibration that was only updated, µs."""


def first_calibration(config: Config) -> Calibration | None:
    """Return the calibration with which a bridge starts; None without ``[calibration]`` and ``[learning]``.

    Without ``[calibration]``, it is the file ``learning.prior``, or the generic prior of ``[learning]``.

    ConfigError: a file is not a calibration.
    """
    settings = config.learning
    for key in CALIBRATION_KEYS:
        if (calibration := config.read(key, load)) is not None:
            return calibration
    if settings is None:
        return None
    parameters = [
        Parameter(name, config.telemetry[name].unit if name in config.telemetry else "", low, high,
                  0.5 * (low + high), 0.5 * (high - low))
        for name, (low, high) in settings.ranges.items()
    ]  # fmt: skip
    from magbridge.learning.estimator import class_prior  # noqa: PLC0415 - only with [learning]

    return class_prior(tuple(parameters))


def open_learner(
    config: Config, calibration: Calibration | None, currents: tuple[str, ...] | None = None
) -> Learner | None:
    """Return the online estimator of ``[learning]``; None without this table or without a calibration.

    `config`: the bridge's configuration.
    `calibration`: the initial calibration.
    `currents`: names of telemetry in ampere; None for the ones in ``[telemetry]``.
    ConfigError: the calibration cannot be updated in flight, or ``learning.reference`` is not a grid.
    """
    if currents is None:
        currents = tuple(name for name, one in config.telemetry.items() if one.unit == "A")
    settings = config.learning
    if settings is None or calibration is None:
        return None
    from magbridge.learning import Learner  # noqa: PLC0415 - only with [learning]

    grid, spread = None, config.align.reference_sigma
    if settings.reference != "igrf":
        from magbridge.field.read import read_grid  # noqa: PLC0415 - it brings scipy

        grid = config.read("learning.reference", read_grid)
        assert grid is not None
        slope = sqrt(2.0) * grid.rms / grid.correlation_length
        spread = hypot(settings.map_sigma, slope * settings.position_sigma)
    try:
        return Learner(
            calibration,
            grid=grid,
            spread=spread,
            turn_on=config.align.turn_on_sigma,
            max_rate=settings.max_rate,
            currents=currents,
        )
    except CalibrationError as error:
        raise ConfigError(config.path, "calibration", str(error)) from error


def kept_path(config: Config) -> Path | None:
    """Return the path of the learned calibration; None without ``[learning]``.

    The file is in ``learning.directory``, or else next to the initial calibration.
    """
    if config.learning is None:
        return None
    first = config.resolve(config.calibration.file if config.calibration else "cal.json")
    folder = config.resolve(config.learning.directory) if config.learning.directory else first.parent
    return folder / f"{first.stem}-learned.json"


class LearningService:
    """Link interface of the online estimator, with its parameters, STATUSTEXTs and MAG_LEARNING.

    `to_keep`: published calibrations to write to a file; the caller empties the queue.
    """

    def __init__(self, learner: Learner, component: Component) -> None:
        from magbridge.learning.alarms import CAUSE_UNITS  # noqa: PLC0415 - only with [learning]

        self._causes = tuple(CAUSE_UNITS)
        self.learner, self._component = learner, component
        self.to_keep: deque[Calibration] = deque(maxlen=4)
        self._published = learner.calibration
        self._first_id = self._id = calibration_id(learner.calibration)
        self._first = learner.first
        self._rate: Rate = component.rates["MAG_LEARNING"]
        self._kept_us = 0
        component.parameters.watch(self._tune)
        self._tune("")

    def _tune(self, name: str) -> None:
        parameters = self._component.parameters
        self.learner.enabled = parameters["MB_LEARN"] >= 0.5
        self.learner.frozen = parameters["MB_LEARN_FREEZE"] >= 0.5
        if name == "MB_LEARN_CMD" and (asked := parameters[name]):
            if asked == ACCEPT:
                self.learner.accept()
            elif asked == FORGET:
                self.learner.forget()
            parameters.set(name, 0.0)

    def sample(self, time_us: int) -> None:
        """Send and apply the changes that a sample at `time_us` (µs) caused, and MAG_LEARNING if due."""
        learner, component = self.learner, self._component
        for notice in learner.notices:
            severity = MAV_SEVERITY.WARNING if notice.grave else MAV_SEVERITY.NOTICE
            component.output.send_statustext(notice.text, severity)
        learner.notices.clear()
        if learner.calibration is not self._published:
            self._published = learner.calibration
            self._id = calibration_id(learner.calibration)
            component.publisher.calibration_id = self._id
            if not learner.renewed or time_us - self._kept_us > FILE_INTERVAL_US:
                self._kept_us = time_us
                self.to_keep.append(learner.calibration)
        if learner.first is not self._first:
            self._first, self._first_id = learner.first, calibration_id(learner.first)
        if learner.enabled and self._rate.due(time_us):
            self._send(time_us)

    def _send(self, time_us: int) -> None:
        learner, offset_us = self.learner, self._component.codec.utc_offset_us
        state, first = learner.state, learner.calibration is learner.first
        going = MAG_LEARNING_STATE.LEARNING if first else MAG_LEARNING_STATE.LEARNED
        self._component.output.send(
            "MAG_LEARNING",
            time_usec=time_us + offset_us,
            alarm_since=state.since_us + offset_us if state.causes else 0,
            calibration_id=self._id,
            first_calibration_id=self._first_id,
            samples=state.learned_samples,
            rms_first=state.rms[0],
            rms_published=state.rms[1],
            rms_learned=state.rms[2],
            better=state.better,
            alarm_amplitude=state.size,
            causes=sum(1 << bit for bit, name in enumerate(self._causes) if name in state.causes),
            state=MAG_LEARNING_STATE.FROZEN if learner.frozen else going,
        )


def keep(learning: LearningService, path: Path) -> str:
    """Write the latest published calibration to `path` if it is new; return the reason of a failure, or "".

    The file always has the calibration with which the bridge corrects. So the initial calibration is written,
    too, if the bridge returns to it.
    """
    if not learning.to_keep:
        return ""
    newest = learning.to_keep[-1]
    learning.to_keep.clear()
    try:
        save(newest, path)
    except WriteError as error:
        return f"learned, but not kept: {error.reason}"
    return ""
