"""cal.json: a written file is read back, and an inconsistent one gives one clear line."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from magbridge.calibration.correct import correct
from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.file import (
    CALIBRATION_FORMAT,
    calibration_id,
    decode_calibration,
    encode_calibration,
    load,
    save,
)
from magbridge.calibration.model import (
    Boresight,
    CalibratedSensor,
    Calibration,
    Noise,
    Parameter,
    Reference,
    Run,
    to_paper,
)
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.errors import CalibrationError, FormatError


@pytest.fixture
def cal() -> Calibration:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(39, 39))
    return Calibration(
        parameters=(Parameter("battpos", "in", -0.4, 0.5, 0.05, 0.45),),
        terms=(
            Polynomial(exponents=full_order(1, 2)),
            Polynomial(exponents=((4,),)),
        ),
        effects=(ChannelEffect(cause="temperature_offset", channel="sensor_temperature", lag=600.0),),
        coefficients=rng.normal(size=39) * 100,
        covariance=root @ root.T,
        noise=Noise(1.0, 0.0, 0.3, 4.0),
        reference=Reference(51_000.0, "IGRF"),
        sensor=CalibratedSensor("digitizer", 3),
        boresight=Boresight((0.0, 0.1, 0.2), ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4))),
        runs=(Run("1", 225, 1.1, (0.3,)),),
        method="auto",
        inputs={"a.csv": "00"},
        software="magbridge 0.1.0",
    )


def test_round_trip_corrects_with_the_same_bits(cal: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "cal.json"
    save(cal, path)
    back = load(path)
    assert encode_calibration(back) == encode_calibration(cal)
    assert calibration_id(back) == calibration_id(cal)
    rng = np.random.default_rng(2)
    samples = rng.normal(size=(30, 3)) * 3e4, rng.uniform(-0.4, 0.5, (30, 2)), np.arange(30.0)
    for got, want in zip(correct(back, *samples), correct(cal, *samples), strict=True):
        np.testing.assert_array_equal(got, want)


def test_the_contract_s_keys_are_there(cal: Calibration) -> None:
    content = json.loads(encode_calibration(cal))
    assert content["format"] == 2
    assert {
        "sensor", "parameters", "terms", "coefficients", "covariance", "noise", "reference", "boresight",
        "runs", "inputs", "software", "effects",
    } <= content.keys()  # fmt: skip
    assert content["parameters"][0].keys() == {"name", "unit", "low", "high", "centre", "scale"}


def test_an_older_format_is_read(cal: Calibration) -> None:
    def older(content: dict[str, Any]) -> None:
        content["format"], noise = 1, content["noise"]
        noise["memory"] = noise.pop("autocorrelation")

    assert encode_calibration(decode_calibration(edit(older, cal))) == encode_calibration(cal)


def test_warnings_are_read_back_and_older_readers_refuse_them(cal: Calibration) -> None:
    doubtful = replace(cal, warnings=("all headings lie within 60 degrees",))
    data = encode_calibration(doubtful)
    assert json.loads(data)["format"] == 3
    assert decode_calibration(data).warnings == doubtful.warnings
    assert "doubts" not in json.loads(encode_calibration(cal))  # with the id that it always had


def test_the_tilt_s_sigma_is_read_back(cal: Calibration) -> None:
    assert cal.boresight is not None
    measured = replace(cal, boresight=msgspec.structs.replace(cal.boresight, tilt_sigma=0.12))
    data = encode_calibration(measured)
    assert json.loads(data)["format"] == 8
    assert decode_calibration(data).boresight == measured.boresight
    with pytest.raises(CalibrationError, match="tilt_sigma: expected deg above 0"):
        decode_calibration(data.replace(b'"tilt_sigma":0.12', b'"tilt_sigma":-0.12'), "cal.json")


def edit(change: Callable[[dict[str, Any]], None], cal: Calibration) -> bytes:
    content = json.loads(encode_calibration(cal))
    change(content)
    return json.dumps(content).encode()


def _drop_row(c: dict[str, Any]) -> None:
    c["covariance"].pop()


EDITS: dict[str, tuple[Callable[[dict[str, Any]], Any], type[Exception], str]] = {
    "newer": (lambda c: c.update(format=CALIBRATION_FORMAT + 1), FormatError, "newer magbridge"),
    "unknown key": (lambda c: c.update(colour="red"), FormatError, "colour"),
    "wrong type": (lambda c: c["noise"].update(sensor="low"), FormatError, "noise.sensor: Expected `float`"),
    "missing": (lambda c: c.pop("reference"), FormatError, "reference"),
    "unknown term": (lambda c: c["terms"][0].update(kind="warp"), FormatError, "a term: expected one of"),
    "no kind": (lambda c: c["terms"][0].pop("kind"), FormatError, "without its kind"),
    "a coefficient less": (
        lambda c: c["coefficients"].pop(), CalibrationError, "covariance: expected 38 x 38"),
    "a row less": (_drop_row, CalibrationError, "covariance: expected 39"),
    "a noise of 1e308 nT": (
        lambda c: c["noise"].update(sensor=1e308), FormatError, "noise.sensor: Expected `float` <= 1"),
    "a variance of 1e308": (
        lambda c: c["covariance"][0].__setitem__(0, 1e308), CalibrationError, "standard deviations up to"),
    "negative variance": (
        lambda c: c["covariance"][0].__setitem__(0, -1.0), CalibrationError, "a variance is negative"),
    "not positive semidefinite": (
        lambda c: c.update(covariance=(np.full((39, 39), -0.9) + 1.9 * np.eye(39)).tolist()),
        CalibrationError, "positive semidefinite"),
    "not symmetric": (
        lambda c: c["covariance"][0].__setitem__(1, c["covariance"][0][1] + 0.5), CalibrationError,
        "symmetric"),
    "no field": (lambda c: c["reference"].update(field=0.0), FormatError, "reference.field"),
    "no scale": (lambda c: c["parameters"][0].update(scale=0.0), FormatError, "scale: Expected"),
    "exponents": (
        lambda c: c["terms"][0].update(exponents=[[0, 0], [1, 0], [2, 0]]), CalibrationError,
        "one for each parameter"),
    "the same parameter": (
        lambda c: c["parameters"].append(c["parameters"][0]), CalibrationError, "'battpos' is named twice"),
    "a boresight's negative variance": (
        lambda c: c.update(boresight={"rotation": [0.0] * 3, "covariance": np.diag([1, 1, -1.0]).tolist()}),
        CalibrationError, "boresight: covariance: a variance is negative"),
    "a boresight beyond a full turn": (
        lambda c: c.update(boresight={"rotation": [0.0, 0.0, 1e308], "covariance": np.eye(3).tolist()}),
        CalibrationError, "boresight: rotation: expected a rotation vector"),
    "a position of 1e150": (
        lambda c: c["parameters"][0].update(high=1e150), FormatError, "high: Expected"),
    "an effect among terms": (
        lambda c: c["terms"].append(c["effects"].pop()), CalibrationError, "terms and effects"),
}  # fmt: skip


@pytest.mark.parametrize("name", EDITS)
def test_edited_by_hand(name: str, cal: Calibration) -> None:
    change, error, match = EDITS[name]
    with pytest.raises(error, match=match) as refused:
        decode_calibration(edit(change, cal), "cal.json")
    assert str(refused.value).startswith("cal.json: ")
    assert "\n" not in str(refused.value)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_edit_is_read_or_refused_in_one_line(data: st.DataObject, cal: Calibration) -> None:
    """Any edited value gives a calibration or one of the two errors."""
    content = json.loads(encode_calibration(cal))
    place: Any = content
    while isinstance(place, (dict, list)) and place:
        keys = sorted(place) if isinstance(place, dict) else list(range(len(place)))
        key = data.draw(st.sampled_from(keys))
        if not isinstance(place[key], (dict, list)) or data.draw(st.booleans()):
            place[key] = data.draw(
                st.none() | st.booleans() | st.floats(allow_nan=False, allow_infinity=False)
                | st.text(max_size=3) | st.integers(-(2**70), 2**70)
                | st.lists(st.integers(-5, 99), max_size=3)
            )  # fmt: skip
            break
        place = place[key]
    try:
        read = decode_calibration(json.dumps(content).encode(), "cal.json")
    except (FormatError, CalibrationError) as refused:
        output = str(refused)
    else:
        output = f"cal.json: {read.method}"
    assert output.startswith("cal.json: ")
    assert "\n" not in output or output == f"cal.json: {content['method']}"


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(places=st.lists(st.tuples(st.integers(0, 10**9), st.integers(0, 255)), min_size=1, max_size=4))
def test_any_damage_is_read_or_refused_in_one_line(places: list[tuple[int, int]], cal: Calibration) -> None:
    content = bytearray(encode_calibration(cal))
    for place, byte in places:
        content[place % len(content)] = byte
    try:
        assert isinstance(decode_calibration(bytes(content), "cal.json"), Calibration)
    except (FormatError, CalibrationError) as refused:
        output = str(refused)
        assert output.startswith("cal.json: ")
        assert "\n" not in output


def from_paper(M: ArrayLike, S: ArrayLike, field: float) -> np.ndarray:
    """Return A of the paper's equation ``A = H_e M S^-1 M^T``."""
    return np.asarray(M) @ np.diag(field / np.asarray(S)) @ np.asarray(M).T


def test_the_paper_s_view_is_the_same_ellipsoid() -> None:
    rng = np.random.default_rng(3)
    root = np.eye(3) + 0.05 * rng.normal(size=(3, 3))
    A = root @ root.T
    M, S = to_paper(A, 50_000.0)
    np.testing.assert_allclose(M @ M.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(M) > 0.0
    np.testing.assert_allclose(from_paper(M, S, 50_000.0), A, atol=1e-12)
    # S are semi-axes: a reading at the end of one has the field's magnitude
    assert np.linalg.norm(A @ (M[:, 0] * S[0])) == pytest.approx(50_000.0)
    np.testing.assert_allclose(to_paper(np.diag([1.1, 0.9, 1.0]), 1.0)[0], np.eye(3), atol=1e-12)
