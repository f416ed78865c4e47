"""What the report says, as people read it."""

from __future__ import annotations

import pytest

from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.report.page import _measured, _number, _physics


@pytest.mark.parametrize("cause", CAUSES)
def test_a_causes_physics_is_a_sentence(cause: str) -> None:
    """One sentence of prose and formulas, without the markup of a docstring."""
    line = _physics(CAUSES[cause])
    assert line.endswith(".")
    assert "`" not in line
    assert ":mod:" not in line


@pytest.mark.parametrize(
    ("value", "sigma", "told"),
    [
        (431.1, 173.0, "430 ± 170"),
        (-1330.2, 22.4, "-1330 ± 22"),
        (1.342, 1.44, "1.3 ± 1.4"),
        (0.01234567, 0.00012, "0.01235 ± 0.00012"),
        (12.0, 0.96, "12.00 ± 0.96"),
        (1e5, 1234.0, "100000 ± 1200"),
    ],
)
def test_a_number_is_written_to_two_digits_of_its_sigma(value: float, sigma: float, told: str) -> None:
    assert f"{_measured(value, sigma)} ± {_measured(sigma, sigma)}" == told


@pytest.mark.parametrize(
    ("value", "told"), [(1073.2, "1070"), (0.0768, "0.0768"), (900.0, "900"), (2, "2"), (0.0, "0")]
)
def test_a_size_is_written_without_an_exponent(value: float, told: str) -> None:
    assert _number(value) == told
