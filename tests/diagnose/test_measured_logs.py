"""Test the diagnosis on measured logs, which have effects that the simulation lacks."""

from pathlib import Path

import numpy as np
import pytest
from measured import held_out_error, tolles_lawson

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.diagnose.report.findings import findings
from magbridge.diagnose.run import diagnose
from magbridge.logs import read

pytestmark = pytest.mark.real


def test_thrusters_leave_the_field_of_an_rov_elsewhere(real_data: Path) -> None:
    """An ArduSub's eight thrusters rest, turn for 15 s, and stop: their magnets have new positions.

    The log's only other event is the turning itself, which no telemetry follows closely enough to name.
    """
    ds = read(real_data / "ardusub" / "small.tlog")
    motors = np.stack([ds[f"servo{k}"].values for k in range(1, 9)])
    turning = np.flatnonzero(np.any(motors != 1500.0, axis=0))
    half = len(motors[0]) // 2
    before, after = ds.isel(time=slice(0, half)), ds.isel(time=slice(half, None))
    result = diagnose([after], fit(observations(before, []), "auto").calibration)
    found = findings(result)
    step = next(one for one in found["findings"] if one["cause"] == "offset_step")["parameters"]
    assert 0.0 <= step["onset"]["value"] - ds.time.values[turning[-1]] < 5.0
    # the vertical channel, half a minute before the thrusters turn and after; a swaying hull adds 0.6 uT
    z = ds.mag_z.values
    seen = z[turning[-1] + 10 :][:60].mean() - z[: turning[0]][-60:].mean()
    assert seen > 1000.0
    assert step["z"]["value"] == pytest.approx(seen, abs=600.0)
    assert found["verdict"] == "partly_explained"
    assert found["unexplained"]["kind"] == "broadband"


def test_a_seaglider_is_better_where_it_was_not_seen(real_data: Path) -> None:
    """A coarse compass over a field: a map's error is among the names, and held-out dives improve."""
    dives = sorted((real_data / "seaglider_sg167").glob("*.nc"))
    known = fit(observations(read(dives[:3]), ["pitchCtl", "vbdCC"])).calibration
    result = diagnose([read(dives[3:4])], known).diagnosis
    assert "map_error" in {one.hypothesis.candidate.cause for one in result.findings}
    assert result.total.shown


# ---- The independent check of ``tools/measured.py``: it finds the eddy currents that are there -----------


@pytest.mark.parametrize("eddy", [0.0, 30.0])
def test_least_squares_finds_eddy_currents_where_they_are(eddy: float) -> None:
    rng = np.random.default_rng(11)
    n = 2000
    t = np.arange(n)
    u = np.stack([np.sin(t / 31.0), np.cos(t / 47.0), 1.0 + 0.5 * np.sin(t / 13.0)], axis=1)
    u /= np.linalg.norm(u, axis=1)[:, None]
    time = np.linspace(0.0, 0.5 * (n - 1), n)
    still, turning = tolles_lawson(u, time, np.full(n, 5e4))
    assert still.shape == turning.shape == (n, 9)
    field = 20.0 * still[:, 0] - 15.0 * still[:, 4]
    field = field + eddy * turning[:, 1] / np.std(turning[:, 1]) + rng.normal(size=n)
    plain, whole = held_out_error(still, field), held_out_error(np.hstack([still, turning]), field)
    assert whole == pytest.approx(1.0, abs=0.1)
    assert plain > 0.5 * eddy
