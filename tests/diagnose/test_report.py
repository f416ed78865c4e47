"""What the report says, as people read it."""

from __future__ import annotations

import numpy as np
import pytest

from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.report.page import IMPLAUSIBLE, _implausible
from magbridge.diagnose.report.words import measured, number, physics, sizes


@pytest.mark.parametrize("cause", CAUSES)
def test_a_causes_physics_is_a_sentence(cause: str) -> None:
    """One sentence of prose and formulas, without the markup of a docstring."""
    line = physics(CAUSES[cause])
    assert line.endswith(".")
    assert "`" not in line
    assert ":mod:" not in line


@pytest.mark.parametrize(
    ("value", "sigma", "told"),
    [
        (431.1, 173.0, "430 ± 170"),
        (-1330.2, 22.4, "\N{MINUS SIGN}1330 ± 22"),
        (1.342, 1.44, "1.3 ± 1.4"),
        (0.01234567, 0.00012, "0.01235 ± 0.00012"),
        (12.0, 0.96, "12.00 ± 0.96"),
        (1e5, 1234.0, "100000 ± 1200"),
    ],
)
def test_a_number_is_written_to_two_digits_of_its_sigma(value: float, sigma: float, told: str) -> None:
    assert f"{measured(value, sigma)} ± {measured(sigma, sigma)}" == told


@pytest.mark.parametrize(
    ("value", "told"), [(1073.2, "1070"), (0.0768, "0.0768"), (900.0, "900"), (2, "2"), (0.0, "0")]
)
def test_a_size_is_written_without_an_exponent(value: float, told: str) -> None:
    assert number(value) == told


def test_sizes_of_one_unit_name_it_once() -> None:
    smallest = {
        "x": (0.5551, "nT/degC"),
        "y": (np.inf, "nT/degC"),
        "z": (0.2, "nT/degC"),
        "delay": (1.0, "s"),
    }
    assert sizes(smallest) == "x 0.555, z 0.2 nT/degC, delay 1 s"
    assert sizes({f"c{k}": (1.0, "nT") for k in range(30)}) == "c0 1, c1 1, c2 1 nT, and 27 more"
    assert sizes({"x": (np.inf, "nT")}) == "invisible"


def test_a_cause_that_is_larger_than_such_causes_are_is_doubted() -> None:
    """A constant of 360 nT where main-field models are 30 nT off."""
    bias = Candidate("reference_bias", None, lambda _: np.ones((1, 1)), np.array([30.0]), ("bias",), ("nT",))
    assert "12 times" in _implausible(bias, np.array([-12.0]))
    assert not _implausible(bias, np.array([0.99 * IMPLAUSIBLE]))
