"""Compare the twin of the Bonne Bay trials with the paper: its Table 2, and what ``diagnose`` finds in it.

The simulated glider performs the paper's runs over a random crustal field, from a boat at -10 degC into
water at 2 degC. Each trial's spirals give a calibration (against the IGRF and the aeromagnetic map, as in the
paper), and the survey between the trials is corrected with each calibration. Only the amplitudes in
``sitl/scenarios/bonne_bay.toml`` were fitted to the paper. With ``--diagnose``, trial 1's calibration is
diagnosed against the true field, the map continued down to the glider, and the map at flight level.

    python tools/bonne_bay.py --seeds 12
    python tools/bonne_bay.py --at-depth --seeds 6     # against the map continued down to the glider
    python tools/bonne_bay.py --diagnose --first 21 --seeds 4
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
from studies import Column, Row, Study
from study.deployment import CHARTS
from study_worlds import MASSES, PAPER, TRIALS, Trials, fly_trials, measure_trials, true_field

from magbridge import diagnose, fit, observations
from magbridge.estimation.residual import rms
from sitl import Twin, load
from sitl.dataset import corrected

FIRST_SEED = 29
"""Number of a simulated world whose errors are near the paper's."""


def run(seed: int, at_depth: bool) -> Iterator[Row]:
    """Simulate one world; yield a row for each trial and method, with the paper's values."""
    flight = fly_trials(seed, at_depth=at_depth)
    survey = flight.parts["survey"]
    known = {"map": rms(survey["reference_field"].to_numpy() - true_field(survey))}
    known["signature"] = float(has_signature(flight))
    for (trial, method), fitted in flight.fits.items():
        row: Row = {"trial": trial, "method": method}
        if isinstance(fitted, str):
            row["failed"] = fitted
        else:
            row["low"], row["high"] = fitted.scales
        paper_runs, paper_survey = PAPER.get((trial, method), (np.nan, np.nan))
        yield row | known | {
            "runs": flight.rms(trial, trial, method), "paper_runs": paper_runs,
            "survey": flight.rms("survey", trial, method), "paper_survey": paper_survey,
        }  # fmt: skip


def has_signature(flight: Trials) -> bool:
    """Return True if a world shows the paper's signature, by ``cubic``, or by ``auto`` if ``cubic`` failed.

    One ellipsoid has a large error, a parameterised fit is at least twice as good on its runs as on the
    survey, and trial 1's survey is worse than trial 2's.
    """
    method = "auto" if any(isinstance(flight.fits[trial, "cubic"], str) for trial in TRIALS) else "cubic"
    runs, survey = ([flight.rms(part or trial, trial, method) for trial in TRIALS] for part in ("", "survey"))
    nominal = min(flight.rms(trial, trial, "nominal") for trial in TRIALS)
    is_worse_on_survey = all(after >= 2.0 * before for before, after in zip(runs, survey, strict=True))
    return nominal >= 3.0 * max(runs) and is_worse_on_survey and survey[0] > survey[1]


def run_diagnosis(reference: str, seed: int) -> list[Row]:
    """Diagnose the survey with trial 1's calibration, without a hint that the cause is a temperature."""
    telemetry = {"reference": "map" if reference == "map" else "true"}
    twin = Twin.draw(load("bonne_bay").replace(telemetry=telemetry), seed)
    parts = measure_trials(twin, at_depth=reference == "map at its depth")
    calibration = fit(observations(parts["trial 1"], MASSES), "auto").calibration
    found = diagnose([parts["survey"]], calibration, training_logs=[parts["trial 1"]]).diagnosis
    survey = parts["survey"]
    both = calibration, found.calibration
    before, after = (rms(corrected(survey, known).total - true_field(survey)) for known in both)
    causes = ", ".join(one.candidate.cause for one in found.findings) or "none"
    return [{"causes": causes, "before": before, "after": after}]


STUDY = Study(
    run,
    ("trial", "method"),
    {
        "runs, nT": Column("runs", np.median, ".1f"),
        "paper": Column("paper_runs", np.median, ".0f"),
        "survey, nT": Column("survey", np.median, ".1f"),
        "paper's survey": Column("paper_survey", np.median, ".0f"),
        "smallest scale": Column("low"),
        "largest": Column("high"),
        "the map's error": Column("map", np.median, ".0f"),
        "paper's signature": Column("signature", np.mean, ".0%"),
    },
)
DIAGNOSIS = Study(
    run_diagnosis,
    ("reference", "causes"),
    {
        "before, nT: least": Column("before", np.min, ".1f"),
        "most": Column("before", np.max, ".1f"),
        "after: least": Column("after", np.min, ".1f"),
        "after: most": Column("after", np.max, ".1f"),
    },
)


if __name__ == "__main__":
    shown = DIAGNOSIS if "--diagnose" in sys.argv else STUDY
    references = ["true", *CHARTS]
    shown.main(__doc__, first=FIRST_SEED, seeds=1, at_depth=False, diagnose=False, references=references)
