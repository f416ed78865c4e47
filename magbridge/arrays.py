"""Define array types for annotations; docstrings state the shapes and units."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["BoolArray", "FloatArray", "IndexArray", "IntArray", "RealArray", "plain"]

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]
RealArray = NDArray[np.floating[Any]]
"""Array of floating-point numbers of any precision, as read from files."""
IndexArray = NDArray[np.intp]
IntArray = NDArray[np.int64]


def plain(value: object) -> object:
    """Convert a numpy number to a Python number for msgspec; NotImplementedError: it is not a number."""
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"{type(value).__name__} cannot be encoded")
