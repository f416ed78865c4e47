"""The causes: each is one class, and nothing else in the package asks for one by its name."""

from __future__ import annotations

import ast
from inspect import getsource
from pathlib import Path

import msgspec
import pytest

import magbridge
from magbridge.diagnose import causes
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.problem import Problem
from magbridge.learning import alarms

ROOM = Path(causes.__file__).parent
ELSEWHERE = {"magbridge/learning"}
"""A learning bridge has a filter of its own, with states that are named after what they stand for."""


def strings(path: Path) -> set[str]:
    tree = ast.parse(path.read_text("utf-8"))
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }


def test_a_cause_is_named_in_its_own_room_alone() -> None:
    package = Path(magbridge.__file__).parent
    unlike_words = set(CAUSES) - {
        "hysteresis",
        "map_error",
    }  # a shape's name; a column that navigation writes
    asked = {
        path.relative_to(package.parent).as_posix(): sorted(unlike_words & strings(path))
        for path in package.rglob("*.py")
        if ROOM not in path.parents and unlike_words & strings(path)
    }
    assert {path for path in asked if Path(path).parent.as_posix() not in ELSEWHERE} == set()


def test_a_cause_is_one_short_class() -> None:
    """Its name stands in one module only, and the class has at most forty lines beside its docstring."""
    for name, cause in CAUSES.items():
        places = [path for path in ROOM.glob("*.py") if name in strings(path)]
        assert len(places) == 1, (name, places)
        assert all((cause.needs, cause.disambiguation, cause.meaning))
        (node,) = ast.parse(getsource(type(cause))).body
        assert isinstance(node, ast.ClassDef)
        first = node.body[1]  # after the docstring
        assert (node.end_lineno or 0) - first.lineno < 60, name


@pytest.mark.parametrize("name", CAUSES)
def test_columns_are_derivatives_of_the_nonlinear_model(name: str, problem: Problem) -> None:
    """For every candidate whose effect the corrector computes as the search does."""
    for candidate in CAUSES[name].candidates(problem)[::7]:
        assert CAUSES[name].jacobian_error(problem, candidate) < 1e-3, candidate.names


@pytest.mark.parametrize("name", CAUSES)
def test_what_a_row_puts_forward_has_its_name_and_can_be_written(name: str, problem: Problem) -> None:
    """A number of numpy's, as is read off a spectrum, is none to a file."""
    made = CAUSES[name].candidates(problem)
    assert {one.cause for one in made} <= {name}
    msgspec.to_builtins([one.effects for one in made])


# ---- one vocabulary of causes ------------------------------------------------------------------------------


def test_a_cause_learned_in_flight_has_a_name_of_the_diagnosis() -> None:
    assert set(alarms.CAUSE_UNITS) <= set(CAUSES)
    assert set(alarms.FROM_ZERO) <= set(alarms.CAUSE_UNITS)
