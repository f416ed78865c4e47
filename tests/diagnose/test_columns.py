"""What several hypotheses are made of is summed up once, and says the same of each."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from magbridge.diagnose.compare.columns import Mixture, beside, parts, together
from magbridge.diagnose.inference import design

FloatArray = NDArray[np.float64]
ROWS = slice(3, 20)


@pytest.fixture
def table() -> FloatArray:
    return np.random.default_rng(1).normal(size=(40, 4))


def test_what_is_shared_is_there_once(table: FloatArray) -> None:
    warm, one = table[:, :2].__getitem__, table[:, 2:].__getitem__
    origins = [Mixture(((warm, np.eye(2)), (one, -origin * np.eye(2)))) for origin in (3.0, 5.0)]
    whole = together([*origins, warm, together(origins)])
    assert [X for X, _ in whole.parts] == [warm, one]
    each = [table[ROWS, :2] - origin * table[ROWS, 2:] for origin in (3.0, 5.0)]
    np.testing.assert_allclose(whole(ROWS), np.hstack([*each, table[ROWS, :2], *each]))
    np.testing.assert_allclose(origins[0].times(np.array([2.0, 7.0]))(ROWS), each[0] * [2.0, 7.0])


def test_columns_that_are_no_mixture_are_their_own_part(table: FloatArray) -> None:
    ((own, M),) = parts(table.__getitem__)
    np.testing.assert_array_equal(own(ROWS) @ M, table[ROWS])


def test_blocks_beside_each_other_are_stored_column_by_column(table: FloatArray) -> None:
    whole = beside([table[:, :1], np.asfortranarray(table[:, 1:])])
    np.testing.assert_array_equal(whole, table)
    assert whole.flags.f_contiguous


def test_threads_give_the_same_in_the_same_order() -> None:
    given = range(20)
    alone = design.in_threads(design.LONG, lambda k: k * k, given)
    assert alone == design.in_threads(design.LONG + 1, lambda k: k * k, given) == [k * k for k in given]
