"""Test the readers on third-party measured data."""

from __future__ import annotations

import datetime
import shutil
from pathlib import Path

import numpy as np
import ppigrf
import pytest

from magbridge import logs
from magbridge.columns import CHANNELS
from magbridge.errors import FormatError
from magbridge.logs.deployment import passed_over

pytestmark = pytest.mark.real


@pytest.fixture
def seaglider(real_data: Path) -> list[Path]:
    return sorted((real_data / "seaglider_sg167").glob("*.nc"))


def test_seaglider_axes_and_scale_are_ours(seaglider: list[Path]) -> None:
    """Regression of the channels on IGRF turned by the logged attitude: one to one, axis by axis."""
    back = logs.read(seaglider, required=CHANNELS)
    assert back.sizes["time"] == 1336 + 1322 + 1383 + 1321 + 1378
    assert back.attrs["heading_reference"] == "magnetic"
    east, north, up = (float(f.item()) for f in ppigrf.igrf(84.7, 8.15, 0, datetime.datetime(2014, 9, 16)))
    horizontal = np.hypot(east, north)
    roll, pitch, heading = (np.radians(back[name].values) for name in ("roll", "pitch", "heading"))
    ahead, right, down = horizontal * np.cos(heading), -horizontal * np.sin(heading), -up
    expected = np.column_stack([
        np.cos(pitch) * ahead - np.sin(pitch) * down,
        np.cos(roll) * right + np.sin(roll) * (np.sin(pitch) * ahead + np.cos(pitch) * down),
        -np.sin(roll) * right + np.cos(roll) * (np.sin(pitch) * ahead + np.cos(pitch) * down),
        np.ones(len(roll)),
    ])  # fmt: skip
    measured = np.column_stack([back[name] for name in CHANNELS])
    matrix, *_ = np.linalg.lstsq(expected, measured)
    np.testing.assert_allclose(np.diag(matrix[:3]), 1, atol=0.06)
    np.testing.assert_allclose(matrix[:3] - np.diag(np.diag(matrix[:3])), 0, atol=0.01)
    np.testing.assert_allclose(np.std(measured - expected @ matrix, axis=0), 0, atol=350)  # nT: 3.5 counts


def test_slocum(real_data: Path) -> None:
    files = sorted((real_data / "slocum_comet").glob("*.?bd"))
    back = logs.read(files)
    flight_only = logs.read([path for path in files if path.suffix == ".dbd"])
    # a pair is one deployment, however named
    np.testing.assert_array_equal(back["battpos"], flight_only["battpos"])
    assert back.sizes["time"] == flight_only.sizes["time"] > 3000
    assert not back.attrs.get("duplicate_rows")  # nor is one read twice
    assert not set(CHANNELS) & set(back.data_vars)
    assert back["battpos"].attrs["units"] == "in"
    for name, low, high in (
        ("battpos", 0.05, 1.5), ("ballast", -232, 232), ("pitch", -40, 35), ("roll", -25, 45),
        ("heading", 0, 360), ("coulomb_current", 0.1, 3.2), ("latitude", 54.7, 54.8), ("longitude", 15, 15.2),
        ("depth", -0.1, 42), ("water_temperature", 5, 18), ("vehicle_temperature", 14, 19),
    ):  # fmt: skip
        assert low <= back[name].min(), name
        assert back[name].max() <= high, name
        assert np.isfinite(back[name]).mean() > 0.98, name


def test_slocum_without_its_list_of_sensors(real_data: Path, tmp_path: Path) -> None:
    shutil.copy(real_data / "slocum_comet" / "comet-2016-174-05-001.dbd", tmp_path)
    with pytest.raises(
        FormatError, match=r"001\.dbd: expected 11d38bfd\.cac, the list of its sensors, next to it or in"
    ):
        logs.read(tmp_path / "comet-2016-174-05-001.dbd")
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("kept", [0.5, 0.99])
def test_truncated_slocum(real_data: Path, tmp_path: Path, kept: float) -> None:
    for path in (real_data / "slocum_comet").glob("*.cac"):
        shutil.copy(path, tmp_path)
    data = (real_data / "slocum_comet" / "comet-2016-174-05-001.dbd").read_bytes()
    (tmp_path / "a.dbd").write_bytes(data[: int(kept * len(data))])
    assert logs.read(tmp_path / "a.dbd").sizes["time"] < 700


def test_compressed_slocum(real_data: Path, tmp_path: Path) -> None:
    """A ``.dcd`` is a ``.dbd`` in LZ4 blocks of 32 KiB, each after its size."""
    block = pytest.importorskip("lz4.block")
    folder = real_data / "slocum_comet"
    for path in folder.glob("*.cac"):
        shutil.copy(path, tmp_path)
    for suffix, packed in ((".dbd", ".dcd"), (".ebd", ".ecd")):
        data = (folder / f"comet-2016-174-05-001{suffix}").read_bytes()
        pieces = [block.compress(data[k : k + 32768], store_size=False) for k in range(0, len(data), 32768)]
        (tmp_path / f"a{packed}").write_bytes(b"".join(len(p).to_bytes(2, "big") + p for p in pieces))
    back, plain = logs.read(tmp_path / "a.dcd"), logs.read(folder / "comet-2016-174-05-001.dbd")
    for name in plain.variables:
        np.testing.assert_array_equal(back[name].values, plain[name].values, err_msg=str(name))


def test_damaged_ardusub_is_read_to_its_end(real_data: Path) -> None:
    back = logs.read(real_data / "ardusub" / "damaged.tlog")
    assert back.sizes["time"] == 627
    assert float(back["time"][-1] - back["time"][0]) == pytest.approx(312.9, abs=0.1)
    assert back.attrs["damages"] > 1900
    assert 80_000 < back.attrs["bytes_skipped"] < 90_000
    streamed = list(logs.read_chunks(real_data / "ardusub" / "damaged.tlog", 100))
    assert passed_over(*(piece.attrs for piece in streamed)) == passed_over(back.attrs)
    np.testing.assert_array_equal(np.concatenate([piece["mag_y"] for piece in streamed]), back["mag_y"])
