"""Do the moving masses matter on a real glider? Each dive is corrected by a calibration of all the others.

A Seaglider's compass counts in steps of about 1 mG (100 nT), and is not corrected for its battery and its
buoyancy engine. Printed for each choice of masses: the RMS error of the dives left out, in the sensor's own
nT, beside that of its steps alone, dive by dive.

    python tools/seaglider.py p167*.nc
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from terminal import command_line, table

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.validate import in_sensor_units
from magbridge.calibration.residual import rms
from magbridge.errors import CalibrationError
from magbridge.logs import read

FEWEST = 30
"""Samples of a run that is worth leaving out."""
COUNT = 100.0
"""nT, a step of the sensor: uniform, so its RMS is a step over sqrt(12)."""
CHOICES: tuple[tuple[str, tuple[str, ...], int], ...] = (
    ("nominal", (), 0),
    ("auto", ("vbdCC",), 1),
    ("auto", ("vbdCC",), 3),
    ("auto", ("pitchCtl",), 1),
    ("auto", ("pitchCtl", "vbdCC"), 1),
    ("auto", ("pitchCtl", "vbdCC"), 3),
    ("auto", ("pitchCtl", "rollCtl", "vbdCC"), 1),
    ("auto", ("pitchCtl", "rollCtl", "vbdCC"), 3),
    ("cubic", ("pitchCtl", "vbdCC"), 3),
)
"""Method, masses, order."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors of samples whose whole run was left out of the fit.

    Attributes
    ----------
    error : (n,) array
        nT, in the sensor's own units; NaN where a run was too short to be left out.
    standardised : (n,) array
        Error of the corrected total field over its sigma.
    runs : (n,) array
        Labels.
    """

    error: FloatArray
    standardised: FloatArray
    runs: NDArray[np.generic]

    @property
    def rms(self) -> float:
        """RMS error, nT."""
        return rms(self.error[np.isfinite(self.error)])

    def by_run(self) -> dict[str, float]:
        """RMS error of each run, nT."""
        kept = np.isfinite(self.error)
        return {
            str(label): rms(self.error[kept & (self.runs == label)]) for label in np.unique(self.runs[kept])
        }


def leave_runs_out(data: Observations, method: str, order: int = 3) -> HeldOut:
    """Fit without each run in turn, and correct that run.

    Parameters are those of :func:`~magbridge.calibration.fitting.fit.fit`.

    Raises
    ------
    CalibrationError
        There are not two runs, or what is left without one cannot be fitted.
    """
    labels, counts = np.unique(data.runs, return_counts=True)
    labels = labels[counts >= FEWEST]
    if len(labels) < 2:
        raise CalibrationError(f"leaving runs out: found {len(labels)} run of {FEWEST} samples, 2 are needed")
    error, standardised = np.full(len(data), np.nan), np.full(len(data), np.nan)
    for label in labels:
        out = np.asarray(data.runs == label)
        calibration = fit(data.part(~out), method, order).calibration
        error[out], standardised[out] = in_sensor_units(calibration, data.part(out))
    return HeldOut(error, standardised, np.asarray(data.runs))


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("files", nargs="+", type=Path, help="a Seaglider's dives, netCDF")
    files = parser.parse_args().files
    deployment = read(sorted(files))
    shown = table(
        f"{len(files)} dives, each left out of its calibration",
        "method", "order", "masses", "left out, nT", "over nominal: by dive", "sigma",
        left=("method", "masses"),
    )  # fmt: skip
    nominal: HeldOut | None = None
    for method, masses, order in CHOICES:
        data = observations(deployment, list(masses))
        try:
            found = leave_runs_out(data, method, order)
        except CalibrationError as refusal:
            shown.add_row(method, str(order), ", ".join(masses), "refused", str(refusal).partition(";")[0])
            continue
        nominal = nominal or found
        ratios = [found.by_run()[dive] / error for dive, error in nominal.by_run().items()]
        shown.add_row(
            method,
            str(order),
            ", ".join(masses) or "none",
            f"{found.rms:.1f}",
            " ".join(f"{ratio:.2f}" for ratio in ratios),
            f"{np.nanstd(found.standardised):.2f}",
        )
    console = Console(width=140)
    console.print(shown)
    console.print(
        f"a step of the sensor is {COUNT:.0f} nT: {COUNT / np.sqrt(12):.0f} nT RMS a channel, if nothing "
        "else were wrong"
    )


if __name__ == "__main__":
    main()
