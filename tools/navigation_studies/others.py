"""Other programs: Stone Soup on our measurements, and our navigator on MagNav.jl's flight."""

from __future__ import annotations

import subprocess
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import xarray as xr
from msgspec.structs import replace as with_options

from magbridge.estimation.residual import rms
from magbridge.field.geodesy import metres_per_degree, separation
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.field.read import read_grid
from magbridge.navigate.batch import navigate
from magbridge.navigate.bound import position_bound
from magbridge.navigate.model import prior, transition
from magbridge.navigate.options import Options
from navigation_studies.simulated import PLACE, START, Map, blocks, sail, synthetic, track_over


def stone_soup(python: str, kind: Map, glider: Options, share: float, seed: int) -> tuple[float, ...]:
    """Return one row of the table: the bound, ours, and both of Stone Soup's filters."""
    grid = synthetic(kind, seed % 10)
    options = with_options(glider, start_sigma=share * grid.correlation_length)
    ds = track_over(grid, options, 1000 + seed)
    ours = sail(ds, grid, options).score()
    found = list(blocks(ds, grid, options))
    moved, before = [], (int(START * 1e6), 0.0)
    for block, travelled in found:
        moved.append(transition(options, (block.time_us - before[0]) * 1e-6, travelled - before[1]))
        before = block.time_us, travelled
    per_latitude, per_longitude = metres_per_degree(PLACE[0])
    x, P = prior(options)
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder) / "given.npz", Path(folder) / "made.npz"
        np.savez(
            given,
            prior_x=x,
            prior_P=P,
            F=np.stack([F for F, _ in moved]),
            Q=np.stack([Q for _, Q in moved]) + 1e-12 * np.eye(6),
            position=[separation(*PLACE, b.latitude, b.longitude) for b, _ in found],
            anomaly=[b.anomaly for b, _ in found],
            variance=[b.variance for b, _ in found],
            slope=[(b.slope_north, b.slope_east) for b, _ in found],
            map=grid.anomaly,
            north=(grid.latitude - PLACE[0]) * per_latitude,
            east=(grid.longitude - PLACE[1]) * per_longitude,
            particles=20_000,
            seed=seed,
        )
        subprocess.run([python, Path(__file__).with_name("stone_soup.py"), given, made], check=True)
        theirs = dict(np.load(made))
    when = np.array([b.time_us for b, _ in found]) * 1e-6
    half = when > 0.5 * (when[0] + when[-1])
    away = np.stack([np.interp(when, ds["time"], ds[f"away_{axis}"]) for axis in ("north", "east")], axis=1)
    row = [ours.bound, ours.drms, ours.nees]
    for name in ("ekf", "particles"):
        error = (theirs[f"{name}_x"][:, :2] - away)[half]
        spread = theirs[f"{name}_P"][half, :2, :2] + 1e-6 * np.eye(2)
        row.append(float(np.sqrt(np.mean(np.sum(error**2, axis=1)))))
        row.append(
            float(
                np.mean(np.einsum("ki,ki->k", error, np.linalg.solve(spread, error[:, :, None])[:, :, 0])) / 2
            )
        )
    return *row, 1e3 * float(theirs["particles_seconds"]) / len(found)


def flight(folder: Path) -> tuple[AnomalyGrid, xr.Dataset]:
    """Return the map of MagNav.jl's simple example, and its flight: field, inertial and true track."""
    log = np.genfromtxt(folder / "xyz.csv", delimiter=",", names=True)
    time = 1.5e9 + log["tt"]
    columns = {
        "total_field": total_field(log["lon"], log["lat"], -log["alt"], time) + log["mag_1_c"],
        "total_field_sigma": np.full(time.size, 3.0),
        "dr_latitude": log["ins_lat"],
        "dr_longitude": log["ins_lon"],
        "gps_latitude": log["lat"],
        "gps_longitude": log["lon"],
        "depth": -log["alt"],
    }
    ds = xr.Dataset({name: ("time", values) for name, values in columns.items()}, {"time": time})
    return read_grid(folder / "map"), ds


def magnav(folder: Path) -> None:
    """Fly MagNav.jl's simple example: its map, its compensated magnetometer, its inertial track.

    Its script promises 'navigation errors' of 7 m from an EKF on 18 inertial states; the inertial track that
    it is given is 2 m off over these 100 s. The errors of the position can be compared; the filters cannot,
    because its filter estimates the errors of the inertial unit.
    """
    grid, ds = flight(folder)
    names = ("gps_latitude", "gps_longitude", "dr_latitude", "dr_longitude")
    true, off = ds[list(names[:2])].to_dataframe().to_numpy(), np.stack([ds[name] for name in names], axis=1)
    inertial = [separation(*row) for row in off.tolist()]
    steps = [np.hypot(*separation(*here, *there)) for here, there in pairwise(true.tolist())]
    seconds = float(ds["time"][-1] - ds["time"][0])
    print(
        f"\n## MagNav.jl's published flight: {seconds:.0f} s, {sum(steps) / seconds:.0f} m/s; "
        "its script promises 7 m\n"
    )
    print(f"{'inertial track as given':<58}{np.sqrt(np.mean(np.sum(np.square(inertial), axis=1))):6.1f} m")
    for label, start, current, drift in (
        ("start 3 m, inertial 0.01 m/s (its settings)", 3.0, 0.01, 0.01),
        ("start 100 m, inertial 0.5 m/s", 100.0, 0.5, 0.1),
    ):
        motion = {"start_sigma": start, "current_sigma": current, "drift": drift}
        for interval in (Options().interval, 0.0):
            options = Options(bias_sigma=3.0, bias_time=600.0, map_sigma=3.0, interval=interval, **motion)
            result = navigate(ds, grid, options, start=tuple(off[0, 2:].tolist()))
            error, smooth = (
                float(np.sqrt((result[f"{p}error_north"] ** 2 + result[f"{p}error_east"] ** 2).mean()))
                for p in ("", "smoothed_")
            )
            bound = position_bound(
                grid, ds["time"], true[:, 0], true[:, 1], options, 3.0, float(ds["depth"].mean()), 1.0
            )
            print(
                f"{label}, interval {interval:.0f} s".ljust(58)
                + f"{error:6.1f} m, smoothed {smooth:.1f} m; bound {rms(bound.sigma):.1f} m"
            )
