"""Test the public names: they exist, are loaded only on use, and do what the docstring states."""

import ast
import re
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from inspect import isfunction
from pathlib import Path

import numpy as np
import pytest
from demos import demo_log

import magbridge as mb
from magbridge.calibration.correct import CorrectedArrays
from magbridge.calibration.model import Noise, identity
from magbridge.records import Corrected

WORD = re.compile(r"``(\w+)``")
ASHORE = {
    "filterpy", "harmonica", "matplotlib", "netCDF4", "pandas", "ppigrf", "pyarrow", "pymavlink", "scipy",
    "xarray",
}  # fmt: skip
"""Packages that no payload computer needs to have, nor the memory for."""


def test_every_public_name_is_there() -> None:
    assert len(mb.__all__) <= 25
    assert not [name for name in mb.__all__ if getattr(mb, name) is None]
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        mb.nothing  # noqa: B018 - it is the look-up that fails


def test_help_has_a_line_for_each_name() -> None:
    reported = {
        name
        for line in mb.__doc__.splitlines()
        if line.startswith("- ``")
        for name in WORD.findall(line.partition(":")[0])
    }
    assert reported == {name for name in mb.__all__ if not name.startswith("_")}
    assert set(mb.__all__) <= set(dir(mb))


def test_a_type_checker_sees_the_same_names() -> None:
    """They are imported for it alone; at run time each comes from the table of homes."""
    tree = ast.parse(Path(mb.__file__).read_text())
    (block,) = [n for n in tree.body if isinstance(n, ast.If)]
    imports = [n for n in block.body if isinstance(n, ast.ImportFrom)]
    seen = {(a.asname or a.name, n.module) for n in imports for a in n.names}
    homes = {(name, f"magbridge.{home}") for name, home in mb._HOMES.items()}
    assert seen == homes | {("plot", "magbridge")}
    assert {name for name, _ in seen} == set(mb.__all__)


READ_LOG = (
    "from magbridge.cli.common import without_dask; without_dask(); "
    "from magbridge.logs.deployment import deployment; deployment('a.csv', [0.0, 1.0], {'mag_x': [1.0, 2.0]})"
)
MAIN = "from magbridge.cli import main; main"
RUN_COMMAND = (
    "import magbridge.bridge.run as bridge; bridge.run = lambda path: None; "
    "from magbridge.__main__ import main; main(['run', '--config', 'bridge.toml'])"
)


IMPORTS = {
    "the package": ("import magbridge", {"numpy", "msgspec", *ASHORE}),
    "the live path": ("import magbridge.bridge.run", ASHORE - {"pymavlink"}),
    "run": (RUN_COMMAND, {"cyclopts", "magbridge.cli"}),
    "the main field": ("from magbridge.field.igrf import igrf; igrf(0, 0, 0, 0)", ASHORE),
    "help": (f"{MAIN}(['--help'])", {"numpy", *ASHORE}),
    "a log that is not there": (f"{MAIN}(['calibrate', 'none', '-o', 'x'])", {"numpy", *ASHORE}),
    "maps": ("from magbridge.field import grid, read, reference", ASHORE),
    "a log": (READ_LOG, {"dask"}),
}
"""Name of a part -> code that loads it, and packages that it must not load."""


@pytest.mark.parametrize(("imports", "heavy"), IMPORTS.values(), ids=IMPORTS)
def test_importing_brings_nothing_heavy(imports: str, heavy: set[str]) -> None:
    script = f"{imports}\nimport sys; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("lacking", [[], ["reference_field"]], ids=["simulated", "as a vehicle's"])
def test_from_a_log_to_corrected_samples(tmp_path: Path, lacking: list[str]) -> None:
    deployment = demo_log().drop_vars(lacking).isel(time=slice(None, None, 2))
    runs, survey = tmp_path / "runs.nc", tmp_path / "survey.nc"
    mb.write(deployment.isel(time=deployment["run"].to_numpy() < 11), runs)
    mb.write(deployment.isel(time=deployment["run"].to_numpy() >= 11), survey)
    found = mb.fit(mb.observations(mb.read(runs), ("battpos", "ballast")))
    mb.save(found.calibration, tmp_path / "cal.json")
    corrected = mb.correct_rows(mb.Correction(mb.load(tmp_path / "cal.json")), mb.read(survey))
    with pytest.raises(mb.MagbridgeError, match="column 'mag_y': expected this column"):
        mb.correct_rows(mb.Correction(found.calibration), mb.read(survey).drop_vars("mag_y"))
    truth = mb.read(survey)["truth_total_field"].to_numpy()
    at_rest = corrected["quality"].to_numpy() == int(corrected["quality"].min())
    error = corrected["total_field"].to_numpy() - truth
    assert at_rest.mean() > 0.9
    level = found.calibration.reference.level_sigma  # unknown to the IGRF, and reported
    assert (level > 100.0) == bool(lacking)
    if lacking:
        assert abs(error[at_rest].mean()) < level
        error -= error[at_rest].mean()
    assert np.sqrt(np.mean(error[at_rest] ** 2)) < 5.0


def test_the_heading_of_corrected_vectors() -> None:
    found = mb.heading(np.array([[10_000.0, 0.0, 40_000.0], [0.0, -10_000.0, 40_000.0]]), 0.0, 0.0)
    np.testing.assert_allclose(found.magnetic, [0.0, 90.0])


def test_functions_stay_functions_after_packages_of_their_names_are_imported() -> None:
    for name in ("survey", "navigate", "diagnose"):
        import_module(f"magbridge.{name}")
        assert isfunction(getattr(mb, name)), name


def test_one_reading_or_arrays_of_them() -> None:
    calibration = identity()
    one = mb.correct(calibration, [30.0, 40.0, 0.0])
    moments = np.array(["2026-01-01"] * 2, "M8[ns]")
    many = mb.correct(calibration, [[30.0, 40.0, 0.0]] * 2, np.empty((2, 0)), moments)
    assert isinstance(one, Corrected)
    assert isinstance(many, CorrectedArrays)
    assert one.total_field == pytest.approx(50.0)
    np.testing.assert_allclose(many.total, 50.0)
    for wrong in ([1.0, 2.0], np.ones((2, 2)), 3.0):
        with pytest.raises(mb.MagbridgeError, match=r"field: expected shape \(3,\) or \(n, 3\)"):
            mb.correct(calibration, wrong)


def test_datetimes_of_every_channel_are_accepted(tmp_path: Path) -> None:
    """Axes with times of their own, as our own netCDF holds them and xarray decodes them."""
    log = demo_log().isel(time=slice(0, 600))
    mb.write(log, tmp_path / "own.nc")
    back = mb.read(tmp_path / "own.nc", decode_times=True)
    assert back["mag_time_x"].dtype.kind == back["time"].dtype.kind == "M"
    assert set(back.data_vars) == set(log.data_vars)
    expected = mb.observations(log, "battpos")
    np.testing.assert_allclose(mb.observations(back, "battpos").field, expected.field, atol=1e-3)
    np.testing.assert_allclose(mb.reference_field(back), mb.reference_field(log))
    plan = mb.plan(replace(identity(), noise=Noise(1.0)), back, runs=1)
    assert len(plan.runs) == 1
