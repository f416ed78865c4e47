"""The numbers of a netCDF variable, as the CF conventions mean them.

References
----------
CF Conventions 1.10, sections 2.5.1 (missing data) and 8.1 (packed data), https://cfconventions.org
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["floats"]

ALL = slice(None)


def floats(variable: Any, rows: slice = ALL) -> NDArray[np.float64]:
    """Return rows of a variable, NaN where the file has nothing.

    That is a number which it declares as such, compared as it is stored, before it is unpacked; or where
    nothing was ever written, which the library fills with a number of its own. A valid range is left aside:
    one that begins at 0 would turn a depth of -2 cm into nothing.
    """
    variable.set_auto_maskandscale(False)
    stored = variable[rows]
    attributes = variable.ncattrs()
    nothing = [variable.getncattr("missing_value")] if "missing_value" in attributes else []
    fill = variable.get_fill_value()
    if "_FillValue" in attributes or (
        fill is not None and stored.dtype.itemsize > 1
    ):  # any byte may be meant
        nothing.append(fill)
    scale, offset = getattr(variable, "scale_factor", 1.0), getattr(variable, "add_offset", 0.0)
    values = stored.astype(np.float64) * scale + offset
    values[np.isin(stored, nothing)] = np.nan
    return np.asarray(values, np.float64)
