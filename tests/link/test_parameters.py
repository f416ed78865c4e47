"""Test the access to every parameter by the parameter protocol."""

import itertools
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from line import Line, MakeLine

from magbridge.bridge.run import load_state
from magbridge.config import Align, Telemetry
from magbridge.errors import FormatError
from magbridge.link.parameters import Parameters, Tunable, alignment, rates, real32, telemetry_ages
from magbridge.link.publish import LIMITS


def write(link: Line, name: str, value: float, kind: int = 9) -> list[Any]:
    return link.send_message("param_set", 1, 191, name.encode(), value, kind)


def test_list_comes_whole_and_paced(link: Line) -> None:
    assert not link.only(link.send_message("param_request_list", 1, 191), "PARAM_VALUE")
    values = link.only(link.to(5), "PARAM_VALUE")
    table = link.component.parameters.table
    assert [value.param_id for value in values] == list(table)
    assert [value.param_index for value in values] == list(range(len(table)))
    assert {(value.param_count, value.param_type) for value in values} == {(len(table), 9)}
    times = [at for at, frame in link.sent if frame[7] == 22]
    assert min(b - a for a, b in itertools.pairwise(times)) == 20_000
    assert len(link.only(link.to(6), "PARAM_VALUE")) == 0


def test_names_and_ranges_are_sound(link: Line) -> None:
    for row in link.component.parameters.table.values():
        assert row.name.startswith("MB_")
        assert len(row.name) <= 16
        assert row.low <= row.default <= row.high or row.default == -1
        assert row.doc


def test_read_by_name_and_index(link: Line) -> None:
    for request in ((b"MB_GAP_FACTOR", -1), (b"", link.component.parameters.names.index("MB_GAP_FACTOR"))):
        (value,) = link.send_message("param_request_read", 1, 191, *request)
        assert (value.param_id, value.param_value) == ("MB_GAP_FACTOR", 2.5)
    for request in ((b"NO_SUCH", -1), (b"", 999), (b"", -2)):
        assert link.send_message("param_request_read", 1, 191, *request) == []


def test_not_ours(link: Line) -> None:
    assert link.send_message("param_request_read", 1, 1, b"MB_GAP_FACTOR", -1) == []
    assert link.send_message("param_request_read", 2, 191, b"MB_GAP_FACTOR", -1) == []
    assert link.send_message("param_request_read", 1, 0, b"", 0) == []  # an index means the autopilot's
    assert link.send_message("param_set", 1, 0, b"NO_SUCH", 1.0, 9) == []


def test_set(link: Line) -> None:
    before = link.component.parameters.revision
    text, value = write(link, "MB_GAP_FACTOR", 4.0)
    assert text.text == "MB_GAP_FACTOR = 4, set by 255:190"
    assert value.param_value == 4.0
    assert link.component.parameters.value_of("align.gap_factor") == 4.0
    assert link.component.parameters.revision == before + 1
    assert link.component.parameters.changed() == {"MB_GAP_FACTOR": 4.0}


def test_what_is_out_of_range_is_refused_and_reported_once_a_second(link: Line) -> None:
    """Each request gets the value; a later request gets it again."""
    wrong = (0.5, 0.5, -1.0, 1e6, nan, inf, -inf, 3.4e38, 0.75)
    received = [message for value in wrong for message in write(link, "MB_GAP_FACTOR", value)]
    assert [one.param_value for one in link.only(received, "PARAM_VALUE")] == [2.5] * len(wrong)
    assert link.component.parameters.changed() == {}
    assert "".join(link.texts(received)) == "MB_GAP_FACTOR: 0.5 is not within 1.01 to 1000"
    assert "".join(link.texts(link.to(2))) == "MB_GAP_FACTOR: 0.75 is not within 1.01 to 1000"
    for later in (4, 6):
        link.to(later)
        assert "".join(link.texts(write(link, "MB_GAP_FACTOR", 0.75))).startswith("MB_GAP_FACTOR: 0.75")


def test_only_real32(link: Line) -> None:
    received = write(link, "MB_GAP_FACTOR", 4.0, kind=6)
    assert link.texts(received) == ["MB_GAP_FACTOR: only REAL32 is taken"]
    assert link.only(received, "PARAM_VALUE")[0].param_value == 2.5


def test_a_rate_parameter_is_obeyed(link: Line) -> None:
    write(link, "MB_R_HEARTBEAT", 5.0)
    assert len(link.only(link.to(10.05), "HEARTBEAT")) == pytest.approx(50, abs=1)
    write(link, "MB_R_STATUS", -1.0)
    assert not link.only(link.to(20), "MAG_STATUS")


def test_kept_parameters_come_back(make_link: MakeLine) -> None:
    link = make_link(kept={"MB_GAP_FACTOR": 3.5, "MB_R_RAW": 2.0, "GONE": 1.0})
    assert link.component.parameters["MB_GAP_FACTOR"] == 3.5
    assert link.component.rates["MAG_RAW"].hertz == 2.0
    texts = link.receive()
    assert any("GONE" in text for text in link.texts(texts))
    # a user who has changed the configuration learns why it has no effect
    assert "kept from the link, not as configured: MB_R_RAW, MB_GAP_FACTOR" in "".join(link.texts(texts))


ROWS = [
    *rates({}, LIMITS),
    *alignment(Align()),
    *telemetry_ages({f"a_rather_long_name_{i}": Telemetry("ATTITUDE", "roll") for i in range(3)}),
]


@given(st.sampled_from(ROWS), st.floats(width=32))
def test_what_is_set_reads_back_or_nothing_changes(row: Tunable, value: float) -> None:
    parameters = Parameters(ROWS)
    assert len(parameters.names) == len(ROWS)  # the names do not collide
    before = parameters[row.name]
    if parameters.set(row.name, value):
        assert real32(parameters[row.name]) == value
        assert real32(row.low) <= value <= real32(row.high)
        again = Parameters(ROWS)
        assert again.restore(parameters.changed()) == []
        assert again[row.name] == parameters[row.name]
    else:
        assert parameters[row.name] == before
        assert parameters.revision == 0


def test_a_default_read_and_written_back_stays_exact() -> None:
    parameters = Parameters(ROWS)
    exact = parameters["MB_MOVING_RATE"]
    assert exact != real32(exact)
    parameters.set("MB_MOVING_RATE", 0.25)
    parameters.set("MB_MOVING_RATE", real32(exact))
    assert parameters["MB_MOVING_RATE"] == exact


@pytest.mark.parametrize(
    "content",
    ['{"parameters": {"a": "b"}}', '{"parameters": {"a": 1e300}}', '{"signing_timestamp": -1}',
     '{"signing_timestamp": 281474976710655}', ""],
)  # fmt: skip
def test_a_store_that_is_damaged(tmp_path: Path, content: str) -> None:
    path = tmp_path / "parameters.json"
    path.write_text(content)
    with pytest.raises(FormatError, match=r"parameters.json"):
        load_state(path)
