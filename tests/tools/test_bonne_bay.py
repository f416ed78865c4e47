"""Guihen's trials in Bonne Bay, flown by the twin."""

from __future__ import annotations

import numpy as np
import pytest
from study_worlds import TRIALS, Trials, fly_trials


@pytest.fixture(scope="module")
def flight() -> Trials:
    return fly_trials(29, methods=("nominal", "auto"))


def test_the_papers_signature_appears(flight: Trials) -> None:
    """Nominal about 150 nT; parameterised far smaller on the runs than on the survey; trial 1 the worse."""
    for trial in TRIALS:
        assert 100 < flight.rms(trial, trial, "nominal") < 220
        assert flight.rms(trial, trial, "auto") < 30
        assert flight.rms("survey", trial, "auto") > 3 * flight.rms(trial, trial, "auto")
        assert flight.rms("survey", trial, "auto") < flight.rms("survey", trial, "nominal")
    assert flight.rms("survey", "trial 1", "auto") > 1.5 * flight.rms("survey", "trial 2", "auto")


def test_it_is_the_temperature_that_spoils_trial_1(flight: Trials) -> None:
    warm = flight.parts["survey"]["sensor_temperature"].to_numpy()
    error = flight.error("survey", "trial 1", "auto", "truth_total_field")
    assert warm[0] < -5
    assert warm[-1] > 0
    assert abs(np.corrcoef(warm, error)[0, 1]) > 0.7
    later = flight.error("survey", "trial 2", "auto", "truth_total_field")
    assert abs(later[len(later) // 2 :].mean()) < abs(error[len(error) // 2 :].mean())
