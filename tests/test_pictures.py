"""A column called ``$\\frac{$`` is drawn as it is called."""

from __future__ import annotations

from io import BytesIO

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure

from magbridge.arrays import plain
from magbridge.pictures import literal


def test_a_name_is_no_mathematics() -> None:
    figure = Figure()
    axis = figure.subplots()
    axis.plot([1.0, 1e6], [1.0, 1e6], label=r"$\frac{$")
    axis.set_xscale("log")
    axis.set_title(r"$\frac{$")
    axis.legend()
    with pytest.raises(ValueError, match=r"ParseException|Expected"):
        figure.savefig(BytesIO())
    literal(figure)
    figure.savefig(BytesIO())
    assert axis.get_xticklabels()[0].get_parse_math()


def test_numpys_numbers_are_encoded() -> None:
    assert msgspec.json.encode({"a": np.float64(0.5), "b": np.int64(3)}, enc_hook=plain) == b'{"a":0.5,"b":3}'
    with pytest.raises(NotImplementedError):
        msgspec.json.encode({"a": object()}, enc_hook=plain)
