"""A log that the calibration was fitted to, diagnosed all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import xarray as xr

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Noise, identity
from magbridge.diagnose.run import diagnose
from magbridge.diagnose.survey import load_survey
from sitl import load, simulate
from sitl.dataset import segments


def test_what_a_calibration_learned_from_a_log_does_not_count_twice() -> None:
    """Freed from that, it shows a filter's attenuation in the turns, most of which it has absorbed."""
    ds = segments(simulate(load("demo"), 2))["calibration"]
    calibration = fit(observations(ds, ("battpos", "ballast")), "auto").calibration

    def named(*again: xr.Dataset) -> set[str]:
        found = diagnose([ds], calibration, training_logs=again).diagnosis
        return {finding.candidate.cause for finding in found.findings}

    assert "filter_lag" in named(ds) - named()


def test_a_report_names_and_counts_the_dives_of_what_is_diagnosed_alone() -> None:
    """Also where only the log that was learned from counts its runs."""
    parts = segments(simulate(load("survey"), 2))
    survey = parts["survey"].drop_vars("run").assign_attrs(source="survey.nc")
    learned = parts["calibration"].assign_attrs(source="runs.nc")
    calibration = replace(identity(), noise=Noise(1.0))
    alone, both = load_survey([survey], calibration), load_survey([survey], calibration, [learned])
    assert len(set(both.dive[~both.learned].tolist())) == len(set(alone.dive.tolist())) > 1
    assert alone.source == both.source == "survey.nc"
    new = both.dive[~both.learned]
    np.testing.assert_array_equal(new - new[0], alone.dive - alone.dive[0])
    assert not set(both.dive[both.learned].tolist()) & set(new.tolist())
