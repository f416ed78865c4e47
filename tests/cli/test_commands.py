"""Test the results and messages of each command."""

import json
import os
import pty
import re
import select
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import Command

from magbridge.calibration.file import load as load_calibration
from magbridge.calibration.file import save as save_calibration
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Parameter, identity
from magbridge.calibration.planning.plan import expected_calibration
from magbridge.cli.common import app
from magbridge.correction import Correction
from magbridge.field.igrf import total_field
from magbridge.field.read import read_grid
from magbridge.logs import read, write
from magbridge.progress import track, waiting
from magbridge.records import Quality
from magbridge.rows import correct_rows

FEW = 40  # rows, which a diagnosis refuses after its other messages


@pytest.mark.parametrize("like", [False, True], ids=["mission", "like a log"])
def test_the_simulated_world_has_a_map(deployment: Path, like: bool, command: Command) -> None:
    driven = ["--trajectory-from", deployment] if like else []
    command("simulate", "demo", "-o", "twin.nc", "--map", "grid.nc", "--seed", "5", *driven)
    twin = read("twin.nc")
    longitude, latitude = (twin[name].to_numpy() for name in ("truth_longitude", "truth_latitude"))
    met = twin["truth_total_field"].to_numpy() - total_field(longitude, latitude, twin["depth"], twin["time"])
    mapped = read_grid("grid.nc").evaluate(longitude, latitude).anomaly
    assert np.corrcoef(met, mapped)[0, 1] > 0.9  # from 90 m up it is smoother than what the vehicle meets
    assert np.std(met - mapped) < 0.5 * np.std(met)


def test_a_simulated_log_need_not_know_the_true_field(command: Command) -> None:
    """The results are otherwise equal."""
    command("simulate", "demo", "-o", "known.nc", "--seed", "5")
    command("simulate", "demo", "-o", "unknown.nc", "--seed", "5", "--reference", "none")
    known, unknown = read("known.nc"), read("unknown.nc")
    assert set(known) - set(unknown) == {"reference_field"}
    np.testing.assert_array_equal(known["mag_x"], unknown["mag_x"])


def test_what_was_passed_over_is_reported(deployment: Path, command: Command) -> None:
    """Messages about damaged and overlapping logs come once, not again for derived files."""
    rows = read(deployment).isel(time=slice(0, 200))
    log = Path("log.tlog")
    write(rows, log)
    data = log.read_bytes()
    log.write_bytes(data[: len(data) // 2] + bytes(500) + data[len(data) // 2 :])
    write(rows.isel(time=slice(150, 200)), "other.nc")
    lines = command("convert", "other.nc", log, "-o", "both.nc").err
    assert lines.startswith("magbridge: in the logs: 5")
    assert " bytes skipped, 1 damaged place, 50 duplicate rows" in lines
    assert not command("convert", "both.nc", "-o", "again.csv").err


def test_what_headings_are_counted_from_may_be_told(deployment: Path, command: Command) -> None:
    command("convert", deployment, "-o", "magnetic.csv", "--heading-reference", "magnetic")
    assert read("magnetic.csv").attrs["heading_reference"] == "magnetic"
    boresights = []
    for reference in ("true", "magnetic"):
        options = "--method", "nominal", "--heading-reference", reference
        text = command("calibrate", deployment, *options, "-o", "cal.json").out
        assert re.search(r"; magnetic heading \d+\.\d\d deg \(1-sigma, with roll and pitch good", text)
        boresights.append(load_calibration("cal.json").boresight)
    assert boresights[0] is not None
    assert boresights[0] == boresights[1]  # roll and pitch determine it, not the headings
    command("correct", "magnetic.csv", "--calibration", "cal.json", "-o", "corrected.csv")
    corrected = read("corrected.csv")
    logged = read("magnetic.csv")["heading"].sel(time=corrected["time"])
    turned = (corrected["vehicle_heading"] - logged - corrected["declination"] + 180.0) % 360.0 - 180.0
    assert abs(turned).max() < 1e-3
    assert abs(corrected["declination"]).min() > 5.0


def test_a_fit_can_be_looked_at(deployment: Path, command: Command) -> None:
    """The plot works for a log without attitude, and with a parameter that the method does not use."""
    write(read(deployment).drop_vars(["roll", "pitch", "heading"]), "bare.csv")
    fitted = "calibrate", "bare.csv", "--method", "nominal", "--parameter", "battpos"
    assert "no heading, which needs roll" in command(*fitted, "-o", "cal.json", "--plot", "fit.png").out
    assert Path("fit.png").stat().st_size > 40_000


def test_correct_writes_what_the_contract_names_as_netcdf_that_others_read(
    deployment: Path, calibration: Path, command: Command
) -> None:
    asked = "correct", deployment, "--calibration", calibration, "-o", "corrected.nc", "--plot", "c.png"
    result = command.json(*asked)
    corrected, truth = read("corrected.nc"), read(deployment)
    assert result["rows"] == corrected.sizes["time"] == 3600
    names = ["total_field", "total_field_sigma", "field_x", "field_y", "field_z", "anomaly", "quality"]
    assert list(corrected)[: len(names)] == names
    assert {"latitude", "longitude", "depth", "roll", "pitch", "heading"} <= set(corrected)
    assert not {"mag_x", "truth_total_field"} & set(corrected)
    np.testing.assert_array_equal(corrected["time"], truth["time"])
    np.testing.assert_array_equal(corrected["quality"] % 1, 0.0)
    error = (corrected["total_field"] - truth["truth_total_field"]).to_numpy()
    assert np.sqrt(np.mean(error**2)) < 1000.0
    assert Path("c.png").read_bytes().startswith(b"\x89PNG")
    with xr.open_dataset("corrected.nc") as theirs:
        assert theirs["time"].dtype.kind == "M"
        assert {"time", "latitude", "longitude", "depth"} == set(theirs.coords)
        quality = theirs["quality"]
        assert len(quality.attrs["flag_masks"]) == len(quality.attrs["flag_meanings"].split())
        assert quality.attrs["flag_masks"].dtype == np.int32
        assert f"calibration {theirs.attrs['calibration_id']}" in theirs.attrs["history"]
        assert "written by magbridge" in theirs.attrs["history"]
        np.testing.assert_array_equal(theirs["latitude"], truth["latitude"])


def test_a_field_unlike_the_earths_is_reported(deployment: Path, calibration: Path, command: Command) -> None:
    """The calibration of another vehicle, with other magnets, gives such a field."""
    own = read(deployment).isel(time=slice(0, 100))
    for name, iron in (("own.nc", 0.0), ("other.nc", 50_000.0)):
        write(own.assign(mag_z=own["mag_z"] + iron), name)
        output = command("correct", name, "--calibration", calibration, "-o", "out.nc")
        doubt = "100 of 100 corrected total fields are outside the Earth's range, 20,000 to 70,000 nT"
        assert (doubt in output.err) == bool(iron)


def test_what_uses_a_calibration_repeats_that_it_is_not_supported(deployment: Path, command: Command) -> None:
    """The calibration is from runs that all head one way; `calibrate` refuses it without --force."""
    log = read(deployment)
    write(log.where((log["heading"] > 200.0) & (log["heading"] < 260.0), drop=True), "one_way.csv")
    fit = "calibrate", "one_way.csv", "--method", "nominal", "-o", "cal.json"
    why = "all headings lie within 59 degrees"
    assert why in command(*fit, code=1).err
    assert not Path("cal.json").exists()
    assert why in command(*fit, "--force").err
    for name, out in (("correct", "out.nc"), ("diagnose", "out")):
        printed = command(name, "one_way.csv", "--calibration", "cal.json", "-o", out)
        assert printed.err.startswith("magbridge: cal.json: the data it was fitted to do not support it: ")
        assert why in printed.err.partition("\n")[0]
    assert "nT RMS, not held out" in printed.out
    assert why in Path("out/report.html").read_text()
    remarks = json.loads(Path("out/findings.json").read_text())["remarks"]
    assert [why in remarks[0], "was fitted to this log" in remarks[1]] == [True, True]


def test_correct_gives_the_same_in_pieces(deployment: Path, calibration: Path) -> None:
    """`correct` processes a month in pieces and passes the state from one to the next."""
    rows = read(deployment)
    whole = correct_rows(Correction(load_calibration(calibration)), rows)
    pieces = Correction(load_calibration(calibration))
    parts = [correct_rows(pieces, rows.isel(time=slice(k, k + 701))) for k in range(0, 3600, 701)]
    for name in whole:
        if name == "anomaly":
            continue  # positions between known ones are found piece by piece
        np.testing.assert_array_equal(whole[name], np.concatenate([part[name] for part in parts]))


def test_a_column_that_the_calibration_needs_is_missed_aloud(deployment: Path, command: Command) -> None:
    needing = identity((Parameter("battpos", "in", low=0.0, high=0.1, centre=0.0, scale=1.0),))
    save_calibration(needing, "cal.json")
    log = read(deployment).isel(time=slice(0, 50))
    write(log.drop_vars("battpos"), "bare.csv")
    output = command("correct", "bare.csv", "--calibration", "cal.json", "-o", "x.csv", "--json")
    assert "no column 'battpos', which the calibration needs: every sample is flagged" in output.err
    assert json.loads(output.out)["flags"]["stale_telemetry"] == json.loads(output.out)["flagged"] == 50
    output = command("correct", deployment, "--calibration", "cal.json", "-o", "x.csv")
    assert not output.err
    assert "stale" not in output.out
    assert "extrapolated " in output.out


def test_a_grid_that_is_not_used_is_reported(deployment: Path, calibration: Path, command: Command) -> None:
    """A grid is added to the IGRF; a log with its own reference uses neither."""
    made = ["simulate", "demo", "-o", "twin.nc", "--map", "grid.nc", "--seed", "5", "--trajectory-from"]
    command(*made, deployment)
    rows = read(deployment).isel(time=slice(0, FEW))
    write(rows, "log.nc")
    write(rows.drop_vars("reference_field"), "bare.nc")
    asked = ("--calibration", calibration, "--grid", "grid.nc", "-o", "doubt")
    words = "has reference_field in every row, so --grid grid.nc is not used"
    assert words in command("diagnose", "log.nc", *asked, code=1).err
    assert words not in command("diagnose", "bare.nc", *asked, code=1).err
    assert words in command("calibrate", deployment, "--grid", "grid.nc", "-o", "x.json").err


def test_numbers_like_minus_9999_are_reported(deployment: Path, calibration: Path, command: Command) -> None:
    rows = read(deployment).isel(time=slice(0, FEW))
    rows["pump_current"] = rows["depth"] * 0.0 + 0.5
    rows["pump_current"].attrs["units"] = "A"
    rows["pump_current"][[7, 30]] = -9999.0
    diagnosed = "--calibration", calibration, "-o", "doubt"
    write(rows, "log.csv")
    warning, refused = command("diagnose", "log.csv", *diagnosed, code=1).err.splitlines()
    assert f"log.csv, column 'pump_current': -9999 in 2 of {FEW} rows is read as a number" in warning
    assert refused.endswith(f"{FEW} samples, at least 60 needed")
    declared = Path("declared.csv")
    declared.write_text("# fill_value = -9999\n" + Path("log.csv").read_text())
    command.refuses("diagnose", declared, *diagnosed)
    assert np.isnan(read(declared)["pump_current"]).sum() == 2


def test_the_logs_that_a_calibration_was_made_from_are_reported(deployment: Path, command: Command) -> None:
    """Two logs of equal name, of two days in two folders, are both recorded."""
    rows = read(deployment)
    for day, begin in (("one", 0), ("two", FEW)):
        Path(day).mkdir()
        write(rows.isel(time=slice(begin, begin + FEW)), f"{day}/log.csv")
    command("calibrate", "one/log.csv", "two/log.csv", "--method", "nominal", "-o", "cal.json")
    assert list(load_calibration("cal.json").inputs) == ["one/log.csv", "two/log.csv"]
    for log in ("one/log.csv", "two/log.csv"):
        output = command("diagnose", log, "--calibration", "cal.json", "-o", "doubt", code=1)
        assert f"{log}: the calibration was fitted to this log" in output.err


@pytest.mark.parametrize("names", [(), ("battpos", "ballast")], ids=["nominal", "two masses"])
def test_plan(names: tuple[str, ...], deployment: Path, command: Command) -> None:
    known = expected_calibration(observations(read(deployment), names).ranges(), 52_000.0, order=2)
    save_calibration(known, "cal.json")
    asked = "plan", "--calibration", "cal.json", "--mission", deployment, "--runs", "2"
    result = command.json(*asked)
    before, first, second = result["expected_worst_nT"]
    assert before > first > second
    assert [set(run) for run in result["runs"]] == [{"pitch", "roll", *names}] * 2
    lines = command(*asked).out.splitlines()
    assert [line.split()[0] for line in lines] == ["run", "none", "1", "2", "each"]


def test_plan_for_a_mission_that_moves_one_of_two_masses(deployment: Path, command: Command) -> None:
    log = read(deployment)
    known = expected_calibration(observations(log, ("battpos", "ballast")).ranges(), 52_000.0, order=1)
    save_calibration(known, "cal.json")
    asked = "plan", "--calibration", "cal.json", "--runs", "2", "--mission"
    write(log.assign(ballast=log["ballast"] * 0.0 + 200.0), "mission.nc")
    runs = command.json(*asked, "mission.nc")["runs"]
    # no further from where it is than a run may be
    assert all(run["ballast"] >= 200.0 - 0.35 * known.parameters[1].scale for run in runs)
    write(log.assign(pitch=log["pitch"] * np.nan), "flat.nc")
    words = "flat.nc (deployment.csv): the mission has no sample with all of roll, pitch"
    assert command.refuses(*asked, "flat.nc").startswith(words)


def test_plan_of_a_survey_needs_no_calibration(deployment: Path, command: Command) -> None:
    asked = "plan", "--mission", deployment
    found = command.json(*asked, "--survey", "3", "--parameter", "battpos")["surveys"]
    assert found[0]["expected_worst_nT"] < found[-1]["expected_worst_nT"]
    assert found[-1]["open"]
    assert "expected --calibration, or --survey HOURS" in command(*asked, code=2).err


def test_help_names_every_command(command: Command) -> None:
    text = command("--help").out
    assert re.findall(r"^│ ([a-z]+) ", text, re.MULTILINE) == sorted(name for name in app if name[0] != "-")
    commands = "calibrate convert correct demo diagnose info init map monitor navigate plan ports replay run"
    assert set(commands.split()) <= set(app)


def test_what_takes_long_says_that_it_is_at_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal (pty), the command prints nothing at first, then step and time, and clears the line."""
    master, slave = pty.openpty()
    os.set_blocking(master, False)
    with os.fdopen(slave, "w") as terminal:
        monkeypatch.setattr("sys.stderr", terminal)
        monkeypatch.setenv("TERM", "xterm")
        for patience, wanted in ((1000.0, ()), (0.0, (b"judging", b"0:00:"))):
            monkeypatch.setattr("magbridge.progress.BAR_DELAY_S", patience)
            shown, deadline = b"", time.monotonic() + (20.0 if wanted else 0.3)
            with waiting("fitting") as step:
                step("judging")
                while time.monotonic() < deadline and not (wanted and all(word in shown for word in wanted)):
                    if select.select([master], [], [], 0.05)[0]:
                        shown += os.read(master, 65536)
            assert (b"judging" in shown) == bool(wanted)
            assert all(word in shown for word in wanted)
        terminal.flush()
        shown += os.read(master, 65536)
    os.close(master)
    assert b"\x1b[2K" in shown.rpartition(b"judging")[2]


def test_progress_without_a_terminal_is_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert list(track(range(3), "deployments", 3, in_lines=True)) == [0, 1, 2]
    assert capsys.readouterr().err == "", "what is quick prints nothing"
    monkeypatch.setattr("magbridge.progress.LINE_INTERVAL_S", 0.0)
    assert list(track(range(2), "deployments", 2, in_lines=True)) == [0, 1]
    title = "magbridge: deployments"
    assert capsys.readouterr().err == f"{title}: 1 of 2, 0 s\n{title}: 2 of 2, 0 s\n"
    assert list(track(range(2), "reading", 2)) == [0, 1]
    assert capsys.readouterr().err == ""


def test_only_what_the_sensor_saw_is_corrected(deployment: Path, calibration: Path, command: Command) -> None:
    """Telemetry in a separate file with its own times adds neither samples nor gaps."""
    rows = read(deployment).isel(time=slice(0, 300))
    whole = correct_rows(Correction(load_calibration(calibration)), rows)
    masses = rows[["battpos", "ballast"]]
    write(masses.assign_coords(time=rows["time"] - 0.5), "vehicle.csv")
    write(rows.drop_vars(masses), "instrument.csv")
    asked = "correct", "vehicle.csv", "instrument.csv", "--calibration", calibration
    output = command(*asked, "-o", "out.nc", "--json")
    result, out = json.loads(output.out), read("out.nc")
    assert (result["rows"], result["left_out"]) == (300, 300)
    np.testing.assert_allclose(out["time"], rows["time"], atol=1e-5)
    before, after = (one["quality"].to_numpy().astype(int) for one in (whole, out))
    np.testing.assert_array_equal(before & Quality.GAP, after & Quality.GAP)
    calm = (before | after) & Quality.MOVING == 0
    assert calm.sum() > 200
    np.testing.assert_allclose(out["total_field"][calm], whole["total_field"][calm], atol=0.1)
