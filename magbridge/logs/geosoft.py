"""Write Geosoft's XYZ: fields separated by commas, headings in a comment, ``LINE 100`` before a line's rows.

:mod:`.text` reads such files; the mark before the rows becomes the column ``line``. A missing value is ``*``.
"""

from __future__ import annotations

from itertools import groupby

import numpy as np
import xarray as xr

from magbridge.logs import text
from magbridge.logs.text import chunks

__all__ = ["FileWriter", "chunks"]


class FileWriter(text.FileWriter):
    """Write successive deployments with the columns of the first one; see :class:`.text.FileWriter`."""

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows, before each survey line its mark, and before the first ones the headings."""
        lines = dataset["line"].to_numpy().tolist() if "line" in dataset else []
        table = dataset.drop_vars("line", errors="ignore")
        if first:
            self._file.write("/ ")
            super().append(table.isel(time=slice(0)), first=True)
        rows = [tuple(cell or "*" for cell in row) for row in self.texts(table)]
        if not lines:
            self._csv.writerows(rows)
            return
        for line, part in groupby(np.arange(len(rows)).tolist(), key=lambda row: lines[row]):
            self._file.write(f"LINE {line:.12g}\n")
            self._csv.writerows(rows[row] for row in part)
