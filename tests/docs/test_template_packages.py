"""Test the templates in ``examples/``, installed and used as by a contributor."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from demos import demo
from pages import ROOT

from magbridge.diagnose.causes import CAUSES, known
from magbridge.diagnose.report.findings import findings
from magbridge.diagnose.run import diagnose
from magbridge.errors import PluginError
from magbridge.sensors import open_driver

TEMPLATES = sorted(path.parent for path in ROOT.glob("examples/*/pyproject.toml"))


def install(template: Path, folder: Path) -> None:
    """Install a template as pip would: its module and its entry points."""
    project = tomllib.loads((template / "pyproject.toml").read_text())["project"]
    declare(folder, project["name"], project["entry-points"])
    for module in template.glob("*.py"):
        (folder / module.name).write_text(module.read_text())


def declare(folder: Path, name: str, groups: dict[str, dict[str, str]]) -> None:
    """Write the metadata of an installed package with its entry points: group -> name -> object."""
    info = folder / f"{name.replace('-', '_')}-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
    lines = []
    for group, points in groups.items():
        lines += [f"[{group}]", *(f"{point} = {target}" for point, target in points.items())]
    (info / "entry_points.txt").write_text("\n".join(lines))


def magbridge(folder: Path, *arguments: object, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the program with the contents of `folder` installed."""
    done = subprocess.run(
        [sys.executable, "-m", "magbridge", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])},
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code, done.stderr
    return done


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site-packages")
    for template in TEMPLATES:
        install(template, folder)
    return folder


def test_the_driver_is_listed_and_reads_in_any_pieces(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(installed))
    output = magbridge(installed, "drivers", "counts")
    assert "nt_per_count" in output.stdout
    long = b"M 1 2" + b" " * 80 + b"3\n"
    data = b"204 -5 7\nM 16204 -5013 49187\r\nM 1 2\nM 60000 2 3\n" + long
    whole, pieces = (open_driver("counts", {"nt_per_count": 2.0, "full_scale": 60_000}) for _ in range(2))
    readings = whole.feed(data)
    assert readings == [reading for byte in data for reading in pieces.feed(bytes([byte]))]
    assert [one.field for one in readings] == [(32408.0, -10026.0, 98374.0), (120000.0, 4.0, 6.0)]
    assert [one.saturated for one in readings] == [False, True]
    assert (whole.frames_bad, whole.bytes_skipped) == (3, 99) == (pieces.frames_bad, pieces.bytes_skipped)
    whole.feed(b"x" * 100_000 + b"\n")
    assert whole.bytes_skipped == 100_099


def test_the_format_is_read_by_every_command(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sample = ROOT / "examples" / "format" / "sample.survey"
    naive = installed / "naive.survey"
    naive.write_text("2026-05-01T10:00:00; 48.31; -57.93; 16204.1; -5013.0; 49187.5; 12.4\n")
    monkeypatch.setenv("TZ", "America/St_Johns")
    magbridge(installed, "convert", naive, "-o", installed / "naive.csv")
    assert "\n1777629600.0," in (installed / "naive.csv").read_text()
    magbridge(installed, "convert", sample, "-o", installed / "sample.csv")
    header, *rows = [
        line for line in (installed / "sample.csv").read_text().splitlines() if not line.startswith("#")
    ]
    assert "battpos [mm]" in header
    assert len(rows) == 120


def test_a_record_that_is_none_is_named(installed: Path) -> None:
    bad = installed / "bad.survey"
    bad.write_text("2026-05-01T10:00:00Z; 48.31; -57.93; 16204.1; -5013.0; 49187.5; 12.4\nand so on\n")
    output = magbridge(installed, "info", bad, code=1)
    assert "bad.survey: row 2: expected a time and 6 numbers" in output.stdout + output.stderr


FAULTS = {
    # format: its module's text, and what is said
    "gone": ("import nowhere_to_be_found\n", "ModuleNotFoundError: No module named 'nowhere_to_be_found'"),
    "raises": (
        "def chunks(path, rows):\n    yield 1 / 0\n",
        "ZeroDivisionError: division by zero (faulty_raises.py, line 2)",
    ),
    "yields": (
        "def chunks(path, rows):\n    yield {}\n", "expected deployments (xarray.Dataset), not dict"
    ),
    "lacks": ("read = None\n", "lacks chunks(path, rows)"),
}  # fmt: skip


def test_a_faulty_format_is_one_line_and_harms_nothing_else(tmp_path: Path) -> None:
    declare(tmp_path, "faulty", {"magbridge.formats": {name: f"faulty_{name}" for name in FAULTS}})
    for name, (text, fault) in FAULTS.items():
        (tmp_path / f"faulty_{name}.py").write_text(text)
        (tmp_path / f"log.{name}").write_text("x")
        output = magbridge(tmp_path, "convert", f"log.{name}", "-o", "log.csv", code=1).stderr
        assert output.startswith(f"magbridge: format '{name}' of the package faulty: ")
        assert fault in output
        assert output.count("\n") == 1
        assert not (tmp_path / "log.csv").exists()
    sound = ROOT / "examples" / "format" / "sample.survey"
    assert "ends in one of" in magbridge(tmp_path, "convert", sound, "-o", "log.csv", code=1).stderr


def test_the_cause_is_put_forward_found_and_explained(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One row is all: the search, the report and the findings take it like any other."""
    monkeypatch.syspath_prepend(str(installed))
    calibration, survey, _ = demo()
    heater = (np.arange(survey.sizes["time"]) // 90 % 2).astype(float)
    hot = survey.assign(mag_z=survey["mag_z"] + 40.0 * heater, heater=("time", heater))
    result = diagnose([hot], calibration)
    found = result.diagnosis
    assert set(found.causes) == {*CAUSES, "heater_field"}
    assert "heater_field" in {one.cause for one in found.possible}
    facts = findings(result)
    assert facts["findings"][0]["follows"]["channel"] == "heater"
    assert facts["findings"][0]["follows"]["axis"] == "z"


def test_a_cause_that_is_none_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    declare(tmp_path, "odd", {"magbridge.causes": {"odd": "oddly:NOTHING"}})
    (tmp_path / "oddly.py").write_text("NOTHING = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(PluginError, match="cause 'odd': oddly:NOTHING is no Cause"):
        known()
