"""What pictures share: a name from a file is drawn as it is, not as mathematics."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.text import Text

__all__ = ["literal"]


def literal(figure: Figure) -> None:
    r"""Let a figure's words be drawn letter by letter: matplotlib would set ``$\frac{$`` and fail.

    Numbers at the ticks are its own, and stay as they are.
    """
    axes = [axis for one in figure.axes for axis in (one.xaxis, one.yaxis)]
    ticks = {id(label) for axis in axes for label in axis.get_ticklabels(which="both")}
    for text in figure.findobj(Text):
        if id(text) not in ticks:
            text.set_parse_math(False)
