"""What several hypotheses are made of is summed up once, and says the same of each."""

from __future__ import annotations

import numpy as np
import pytest
from posed import right
from scipy.sparse import csr_array

from magbridge.arrays import FloatArray
from magbridge.diagnose import joint as design
from magbridge.diagnose.columns import Columns, Interpolated, Mixture, join_columns, parts, times
from magbridge.diagnose.evidence import information
from magbridge.diagnose.joint import fit_joint
from magbridge.diagnose.problem import side_by_side

ROWS = slice(3, 20)


@pytest.fixture
def table() -> FloatArray:
    return np.random.default_rng(1).normal(size=(40, 4))


def test_what_is_shared_is_there_once(table: FloatArray) -> None:
    warm, one = table[:, :2].__getitem__, table[:, 2:].__getitem__
    origins = [Mixture(((warm, np.eye(2)), (one, -origin * np.eye(2)))) for origin in (3.0, 5.0)]
    whole = join_columns([*origins, warm, join_columns(origins)])
    assert [X for X, _ in whole.parts] == [warm, one]
    each = [table[ROWS, :2] - origin * table[ROWS, 2:] for origin in (3.0, 5.0)]
    np.testing.assert_allclose(whole(ROWS), np.hstack([*each, table[ROWS, :2], *each]))
    np.testing.assert_allclose(origins[0].times(np.array([2.0, 7.0]))(ROWS), each[0] * [2.0, 7.0])


def test_columns_without_a_mixture_are_their_own_part(table: FloatArray) -> None:
    ((own, M),) = parts(table.__getitem__)
    np.testing.assert_array_equal(own(ROWS) @ M, table[ROWS])


def test_blocks_next_to_each_other_are_stored_column_by_column(table: FloatArray) -> None:
    whole = side_by_side([table[:, :1], np.asfortranarray(table[:, 1:])])
    np.testing.assert_array_equal(whole, table)
    assert whole.flags.f_contiguous


def test_coefficients_leave_the_same_without_their_columns(table: FloatArray) -> None:
    weights, c = csr_array(np.maximum(table[:, 1:], 0.0)), np.array([0.5, -2.0])
    whole = Mixture(((Interpolated(weights, table[5:8]), table[:4, :2]), (table.__getitem__, table[4:8, :2])))
    shown = weights.toarray() @ table[5:8] @ table[:4, :2] + table @ table[4:8, :2]
    np.testing.assert_allclose(whole(ROWS), shown[ROWS])
    np.testing.assert_allclose(times(whole, ROWS, c), shown[ROWS] @ c)


def test_strangers_say_what_they_say_among_others() -> None:
    problem, made = right(400), np.random.default_rng(2).normal(size=(400, 7))
    one, other, model = (made[:, own].__getitem__ for own in (slice(3), slice(3, 5), slice(5, 7)))
    columns: list[Columns] = [
        Mixture(((one, np.eye(3)[:, :2]), (other, np.eye(2)))),
        made[:, 1:3].__getitem__,
        model,
    ]
    fit = fit_joint(problem, [model], 1)
    apart, whole = (information(problem, fit.noise, fit, columns, k).fitted(fit) for k in (2, 0))
    for own in (slice(2), slice(2, 4)):
        np.testing.assert_allclose(apart.matrix[own, own], whole.matrix[own, own])
    np.testing.assert_allclose(apart.score, whole.score)
    np.testing.assert_allclose(apart.shift, whole.shift)


def test_threads_give_the_same_in_the_same_order() -> None:
    given = range(20)
    alone = design.in_threads(design.LONG, lambda k: k * k, given)
    assert alone == design.in_threads(design.LONG + 1, lambda k: k * k, given) == [k * k for k in given]
