"""Write matplotlib figures to files, with all texts drawn literally."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.text import Text

from magbridge.files import atomic_path

__all__ = ["literal", "save"]


def save(figure: Figure, path: str | Path, dpi: int = 110) -> None:
    """Write a figure as PNG, PDF or SVG, by its suffix; WriteError: the file cannot be written."""
    literal(figure)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi)


def literal(figure: Figure) -> None:
    """Make matplotlib draw a ``$`` in the texts of a figure literally, except in its own labels of ticks."""
    axes = [axis for one in figure.axes for axis in (one.xaxis, one.yaxis)]
    ticks = {id(label) for axis in axes for label in axis.get_ticklabels(which="both")}
    for text in figure.findobj(Text):
        if id(text) not in ticks:
            text.set_parse_math(False)
