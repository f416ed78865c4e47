"""Array types, for annotations; docstrings give the shapes and units."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["BoolArray", "FloatArray", "IndexArray", "IntArray", "RealArray", "plain"]

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]
RealArray = NDArray[np.floating[Any]]
"""Array of numbers of either precision, as files hold them."""
IndexArray = NDArray[np.intp]
IntArray = NDArray[np.int64]


def plain(value: object) -> object:
    """Return a numpy number as Python's, for msgspec, which encodes only those.

    NotImplementedError: it is not a numpy number.
    """
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"{type(value).__name__} cannot be encoded")
