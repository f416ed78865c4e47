"""Terms that runs determine or not, and the message of the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from gliders import Gliders, codes

from magbridge.calibration.fitting.checks import combinations
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import polynomial_samples
from magbridge.calibration.terms import full_order


def test_table_1_sees_63_of_90_coefficients(glider: Gliders) -> None:
    """Ballast at two positions: its squares and cubes are not distinguishable."""
    runs = glider(0, 2).runs
    held = np.array([np.median(runs.parameters[runs.runs == r], axis=0) for r in runs.runs])
    samples = polynomial_samples(replace(runs, parameters=held), full_order(2, 3))
    seen = combinations(samples, np.zeros(90), 1.0)
    assert len(seen) == 63
    assert (np.diff(seen) >= 0.0).all()


def test_readings_that_a_fit_multiplies_are_reported(glider: Gliders) -> None:
    """Anomalies shrink with the readings: a reference that is wrong along the track can do that unnoticed."""
    runs = glider(0, 2).runs
    reported = [fit(replace(runs, field=gain * runs.field), "nominal").warnings for gain in (1.0, 1.3, 0.8)]
    plain, shrunk, grown = (
        [one.values["low"] for one in warnings if one.code == "unusual_scales"] for warnings in reported
    )
    assert not plain
    assert shrunk[0] < 0.85
    assert grown[0] > 1.03


def test_warnings_are_in_a_pilot_s_words(glider: Gliders) -> None:
    words = "\n".join(warning.text for warning in fit(glider(0, 2).runs).warnings)
    assert "ballast was nearly always at 2 positions (-200 and 200 cm3)" in words
    assert "battpos and ballast always moved together" in words
    assert "roll stayed within" in words
    assert "the vertical offset is known only to" in words
    dives = glider(0, 2).runs.part(np.degrees(glider(0, 2).runs.attitude[:, 1]) < 0.0)
    one = replace(dives, parameters=dives.parameters[:, :1], names=("battpos",), units=("in",))
    assert "one_pitch_sign" in codes(fit(one))


def test_a_fit_from_a_corner_of_the_compass_is_not_supported(glider: Gliders) -> None:
    """Any iron fits samples that all head one way: a real ArduSub was 300 nT off there, 1,700 beyond."""
    runs = glider(0, 2).runs
    turned = np.degrees(runs.attitude[:, 2]) % 360.0
    found = fit(runs.part((turned > 200.0) & (turned < 260.0)), "nominal")
    assert not found.supported
    assert any("all headings lie within 60 degrees" in doubt for doubt in found.calibration.warnings)
    assert found.calibration.warnings[-1] in found.warnings[0].text
    assert fit(runs, "nominal").supported


def test_a_fit_that_the_data_cannot_hold_reports_it(glider: Gliders) -> None:
    runs = glider(0, 2).runs
    few = runs.part((np.asarray(runs.runs) < 2) & (np.cos(runs.attitude[:, 2]) > 0.5))
    found = fit(few, "cubic")
    assert not found.supported
    assert found.warnings[0].code == "unsupported_fit"
    assert found.warnings[0].severity == "error"
    assert fit(runs).supported
