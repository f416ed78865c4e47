"""Read and write a calibration as ``cal.json``, and check its content.

If the file was cut short, was written by a newer magbridge, or is inconsistent, the error is one line that
names the file and the expected content.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from zlib import crc32

import msgspec
import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.heading import DEFAULT_TILT_SIGMA_DEG
from magbridge.calibration.model import (
    MIN_HALF_RANGE,
    Boresight,
    CalibratedRange,
    CalibratedSensor,
    Calibration,
    Noise,
    Parameter,
    Reference,
    Run,
)
from magbridge.calibration.scalar import PLATFORM_TERMS, ScalarSensor
from magbridge.calibration.terms import Effect, Polynomial, Term, term_class
from magbridge.datasets import expect
from magbridge.errors import CalibrationError, FormatError
from magbridge.files import atomic_path, contents

__all__ = ["CALIBRATION_FORMAT", "calibration_id", "decode_calibration", "encode_calibration", "load", "save"]

CALIBRATION_FORMAT = 8
"""Newest version of the layout; magbridge reads it and all earlier versions. Version 1 called the noise's
``autocorrelation`` ``memory``. Version 3 added ``doubts``, 4 ``white`` of the noise, ``level`` and
``level_sigma`` of the reference, 5 ``sensors``, 6 ``conditions``, 7 ``filter_cutoff`` of the sensor, 8
``tilt_sigma`` of the boresight. A file holds each of these keys only if it has a value."""

MAX_STATED_SIGMA = 1e15
"""Largest accepted standard deviation, in the coefficient's unit: its square is still a float32."""

AS_IN_MEMORY = (
    "software", "method", "sensor", "parameters", "noise", "reference", "boresight", "runs", "inputs",
    "level", "sensors", "conditions",
)  # fmt: skip
"""Keys of the file that are attributes of :class:`~.model.Calibration` with the same name and form."""


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """Layout of ``cal.json``: its keys and their types. The names are part of the public format."""

    format: int
    software: str
    method: str
    sensor: CalibratedSensor
    parameters: tuple[Parameter, ...]
    terms: list[dict[str, Any]]
    effects: list[dict[str, Any]]
    coefficients: list[float]
    covariance: list[list[float]]
    noise: Noise
    reference: Reference
    boresight: Boresight | None
    runs: tuple[Run, ...]
    inputs: dict[str, str]
    doubts: tuple[str, ...] = ()
    level: tuple[float, ...] = ()
    sensors: tuple[ScalarSensor, ...] = ()
    conditions: tuple[CalibratedRange, ...] = ()


class _Version(msgspec.Struct):
    format: int


def encode_calibration(calibration: Calibration) -> bytes:
    """Return `calibration` as the content of ``cal.json``, with one key in each line."""
    content = _File(
        format=_format(calibration),
        terms=[_term_out(term) for term in calibration.terms],
        effects=[_term_out(effect) for effect in calibration.effects],
        coefficients=calibration.coefficients.tolist(),
        covariance=calibration.covariance.tolist(),
        doubts=calibration.warnings,
        **{name: getattr(calibration, name) for name in AS_IN_MEMORY},
    )
    encode = msgspec.json.encode
    # omit empty keys that older readers do not know
    optional = "doubts", "level", "sensors", "conditions"
    names = [name for name in _File.__struct_fields__ if name not in optional or getattr(content, name)]
    values = {name: getattr(content, name) for name in names}
    for key, lately in (("noise", "white"), ("reference", "level_sigma"), ("sensor", "filter_cutoff")):
        known = msgspec.structs.asdict(values[key])
        values[key] = {name: value for name, value in known.items() if name != lately or value}
    lines = [encode(name) + b": " + encode(value) for name, value in values.items()]
    return b"{\n" + b",\n".join(lines) + b"\n}\n"


def _format(calibration: Calibration) -> int:
    """Return the oldest format that can represent a calibration."""
    if calibration.boresight and calibration.boresight.tilt_sigma != DEFAULT_TILT_SIGMA_DEG:
        return 8
    if calibration.sensor.filter_cutoff:
        return 7
    if calibration.conditions:
        return 6
    if calibration.sensors:
        return 5
    if calibration.noise.white or calibration.level:
        return 4
    return 3 if calibration.warnings else 2


def decode_calibration(data: bytes, file: str | Path = "cal.json") -> Calibration:
    """Return the calibration in the content of a ``cal.json``; the inverse of :func:`encode_calibration`.

    Parameters
    ----------
    data : bytes
        Content of the file.
    file : path
        Name of the file for error messages.

    Raises
    ------
    FormatError
        The content is not JSON, has a newer format, or a key is missing, unknown or of the wrong type.
    CalibrationError
        The numbers are inconsistent.
    """
    try:
        # read the format's number first: a newer file gets its own message
        version = msgspec.json.decode(data, type=_Version).format
        if version > CALIBRATION_FORMAT:
            raise FormatError(
                file,
                f"written by a newer magbridge (format {version}; this one reads up to {CALIBRATION_FORMAT})",
            )
        raw = msgspec.json.decode(data)
        # format 1 had another name for the autocorrelation
        if version < 2 and isinstance(raw.get("noise"), dict) and "memory" in raw["noise"]:
            raw["noise"]["autocorrelation"] = raw["noise"].pop("memory")
        content = msgspec.convert(raw, _File)
        terms = tuple(_term_in(term, file) for term in content.terms)
        effects = tuple(_term_in(effect, file) for effect in content.effects)
    except (msgspec.DecodeError, UnicodeDecodeError) as problem:
        raise FormatError(
            file, f"not a calibration as magbridge calibrate writes it: {_plain(problem)}"
        ) from problem
    try:
        return _checked(content, terms, effects)
    except CalibrationError as problem:
        raise CalibrationError(f"{file}: {problem}") from problem


def load(path: str | Path) -> Calibration:
    """Return the calibration in a file ``cal.json``.

    FormatError: the file cannot be opened. Other errors are those of :func:`decode_calibration`.
    """
    return decode_calibration(contents(path), path)


def save(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration to a file ``cal.json`` in one step, so that it is never incomplete.

    WriteError: the file cannot be written; the previous file is unchanged. WrongUse: `calibration` is not a
    Calibration; the result of a fit has one.
    """
    expect("calibration", calibration, Calibration, "magbridge.load(path)")
    with atomic_path(path) as temporary:
        temporary.write_bytes(encode_calibration(calibration))


def calibration_id(calibration: Calibration) -> int:
    """Return the CRC-32 of a calibration's file, which identifies the calibration in MAVLink messages."""
    return crc32(encode_calibration(calibration))


def _term_out(term: Term) -> dict[str, Any]:
    return {"kind": term.kind, **msgspec.to_builtins(term)}


def _term_in(raw: dict[str, Any], file: str | Path) -> Term:
    settings = dict(raw)
    kind = settings.pop("kind", None)
    if not isinstance(kind, str):
        raise FormatError(file, "a term without its kind")
    try:
        return msgspec.convert(settings, term_class(kind))
    except CalibrationError as problem:
        raise FormatError(file, str(problem)) from problem


def _checked(content: _File, terms: tuple[Term, ...], effects: tuple[Term, ...]) -> Calibration:
    """Return the calibration of a file's `content`; CalibrationError: its numbers are inconsistent."""
    # shapes before values: a ragged covariance has no array
    coefficients = np.array(content.coefficients, float)
    size = coefficients.size
    if [len(row) for row in content.covariance] != [size] * size:
        raise CalibrationError(f"covariance: expected {size} x {size} numbers")
    covariance = np.array(content.covariance, float)
    _check_covariance(covariance)
    if content.boresight:
        _check_covariance(np.array(content.boresight.covariance), "boresight: ")
        if np.abs(content.boresight.rotation).max() > 2.0 * np.pi:
            raise CalibrationError("boresight: rotation: expected a rotation vector, rad, up to a full turn")
        if not 0.0 < content.boresight.tilt_sigma <= 90.0:
            raise CalibrationError("boresight: tilt_sigma: expected deg above 0, up to 90")
    _check_settings(content)
    # plugins may define terms and effects; each must be in its own list
    positions = tuple(term for term in terms if isinstance(term, Polynomial))
    others = tuple(effect for effect in effects if isinstance(effect, Effect))
    if len(positions) < len(terms) or len(others) < len(effects):
        raise CalibrationError(
            "terms and effects: an effect stands among the terms or a term among the effects"
        )
    return Calibration(
        terms=positions,
        effects=others,
        coefficients=coefficients,
        covariance=covariance,
        warnings=content.doubts,
        **{name: getattr(content, name) for name in AS_IN_MEMORY},
    )


def _check_settings(content: _File) -> None:
    """Raise CalibrationError if parameters, conditions or scalar sensors are inconsistent."""
    names = [parameter.name for parameter in content.parameters]
    if twice := [name for name in names if names.count(name) > 1]:
        raise CalibrationError(f"parameter {twice[0]!r} is named twice")
    for parameter in content.parameters:
        if not parameter.low <= parameter.high:
            raise CalibrationError(f"parameter {parameter.name!r}: expected low <= high")
    for condition in content.conditions:
        if condition.name not in MIN_HALF_RANGE or not condition.low <= condition.high:
            raise CalibrationError(
                f"condition {condition.name!r}: expected low <= high, of {' or '.join(MIN_HALF_RANGE)}"
            )
    for sensor in content.sensors:
        _check_scalar(sensor)


def _check_scalar(sensor: ScalarSensor) -> None:
    """Raise CalibrationError if a scalar sensor has inconsistent numbers."""
    size = PLATFORM_TERMS + 3 * len(sensor.channels) + len(sensor.power_cycles)
    where = f"sensor {sensor.column!r}: "
    if not len(sensor.coefficients) == len(sensor.prior_sigma) == len(sensor.covariance) == size:
        raise CalibrationError(f"{where}expected {size} coefficients, prior_sigma and rows of covariance")
    if {len(row) for row in sensor.covariance} != {size} or not sensor.reference_field > 0.0:
        raise CalibrationError(f"{where}expected a covariance of {size} x {size} and reference_field > 0")
    _check_covariance(np.array(sensor.covariance), where)


def _check_covariance(covariance: FloatArray, prefix: str = "") -> None:
    """Raise CalibrationError, with `prefix`, unless a matrix is symmetric and positive semidefinite."""
    if np.abs(covariance).max(initial=0.0) > MAX_STATED_SIGMA**2:
        raise CalibrationError(f"{prefix}covariance: expected standard deviations up to {MAX_STATED_SIGMA:g}")
    # a correlation beyond 1 cannot be a covariance; the scale makes the test independent of units
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    with np.errstate(over="ignore"):  # a covariance with a variance of zero: rejected below
        correlation = covariance / scale / scale[:, None]
    if (np.diag(covariance) < 0.0).any() or np.abs(correlation).max(initial=0.0) > 1.0 + 1e-6:
        raise CalibrationError(f"{prefix}covariance: a variance is negative or a correlation above 1")
    if not np.allclose(correlation, correlation.T, rtol=0.0, atol=1e-9):
        raise CalibrationError(f"{prefix}covariance: expected a symmetric matrix")
    if np.linalg.eigvalsh(correlation)[0] < -1e-6 * len(correlation):
        raise CalibrationError(f"{prefix}covariance: expected a positive semidefinite matrix")


def _plain(problem: Exception) -> str:
    """Return msgspec's message with the path first: ``noise.sensor: Expected `float`, got `str```."""
    text, _, path = str(problem).partition(" - at ")
    return f"{path.strip('`').removeprefix('$.')}: {text}" if path else text
