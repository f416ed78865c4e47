"""The paper's trials, calibrated at -10 degC and surveyed at +2 degC: what ``diagnose`` finds.

    python tools/bonne_bay_diagnosis.py --seeds 3

Prints, beside the paper, the twin's survey error before and after, against the true field. The detector has
no hint that the cause is a temperature.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "2")

import xarray as xr
from bonne_bay_trials import MASSES, PAPER, measure
from study.deployment import CHARTS
from terminal import command_line

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.residual import rms
from magbridge.diagnose.run import diagnose
from sitl.dataset import corrected
from sitl.scenario import load
from sitl.twin import Twin

REFERENCES = ("true", *CHARTS)
"""The true field; the aeromagnetic map continued down to the glider, as ``--grid`` does; the map as flown."""


def fly(seed: int, reference: str) -> dict[str, xr.Dataset]:
    """Return the twin's three parts, on one time base, masses at rest, with one of :data:`REFERENCES`."""
    telemetry = {"reference": "map" if reference == "map" else "true"}
    twin = Twin.draw(load("bonne_bay").replace(telemetry=telemetry), seed)
    return measure(twin, at_depth=reference == "map at its depth")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="worlds, from 21 on")
    options = parser.parse_args()
    paper = PAPER["trial 1", "cubic"][1]
    print(
        "| world | reference | paper | twin before | twin after | noise floor | found |\n"
        "|---|---|---|---|---|---|---|"
    )
    for reference in REFERENCES:
        for seed in range(21, 21 + options.seeds):
            parts = fly(seed, reference)
            calibration = fit(observations(parts["trial 1"], MASSES), "auto").calibration
            found = diagnose([parts["survey"]], calibration, training_logs=[parts["trial 1"]])
            named = ", ".join(
                f"{h.candidate.cause} ({h.candidate.channel})" if h.candidate.channel else h.candidate.cause
                for h in found.findings
            )
            survey, floor = parts["survey"], load("bonne_bay").instrument.noise_sigma
            before, after = (
                rms(corrected(survey, known).total - survey["truth_total_field"].to_numpy())
                for known in (calibration, found.calibration)
            )
            print(
                f"| {seed} | {reference} | {paper} nT | {before:.1f} nT | {after:.1f} nT | {floor:.1f} nT | "
                f"{found.verdict}: {named or '-'} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
