"""Do the moving masses matter on a real glider? Each dive is corrected by a calibration of all the others.

A Seaglider's compass counts in steps of about 1 mG (100 nT), and is not corrected for its battery and its
buoyancy engine. Printed for each choice of masses: the RMS error of the dives left out, in the sensor's own
nT, beside that of its steps alone, dive by dive.

    python tools/seaglider.py ../shared/data/seaglider_sg167/*.nc
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from terminal import command_line, table

from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.validate import HeldOut, leave_runs_out
from magbridge.errors import CalibrationError
from magbridge.logs import read

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
        ratios = [found.by_run()[dive] / rms for dive, rms in nominal.by_run().items()]
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
