"""Test line protocols that the configuration describes."""

from functools import reduce
from math import inf
from operator import xor
from typing import Any
from zlib import crc32

import pytest

from magbridge.records import Reading
from magbridge.sensors import is_scalar, open_driver


def read(text: str, **options: Any) -> list[Reading]:
    return open_driver("ascii", options).feed(text.encode())


def test_aps_1540() -> None:
    text = " 0.21345 -0.04521  0.48766  21.45\r\n"
    (reading,) = read(text, columns=["x", "y", "z", "temperature"], unit="G", range=65_000.0)
    assert reading.field == pytest.approx((21_345.0, -4_521.0, 48_766.0))
    assert reading.temperature == 21.45
    assert (reading.counts, reading.sequence, reading.saturated) == (None, None, False)


def test_fgsensors_logger_with_its_header_line() -> None:
    columns, modulo = ["time", "x", "y", "z", "*"], 4294967.296
    options = {"separator": ",", "columns": columns, "time_unit": "ms", "time_modulo": modulo}
    driver = open_driver("ascii", options)
    header = b"Timestamp_ms,B1x_nT,B1y_nT,B1z_nT,B1v_nT,Lat_deg\r\n"
    (reading,) = driver.feed(header + b"123456,24312.5,-1823.1,44521.8,50234.6,46.05\r\n")
    assert reading.field == (24312.5, -1823.1, 44521.8)
    assert reading.device_time == pytest.approx(123.456)
    assert driver.time_modulo == modulo
    assert (driver.frames_bad, driver.bytes_skipped) == (1, len(header) - 1)


@pytest.mark.parametrize(
    ("checksum", "digits"),
    [
        ("nmea", lambda text: f"{reduce(xor, text[1:]):02X}"),
        ("xor", lambda text: f"{reduce(xor, text):02x}"),
        ("sum", lambda text: f"{sum(text) % 256:02X}"),
        ("crc32", lambda text: f"{crc32(text):08X}"),
    ],
)
def test_checksums(checksum: str, digits: Any) -> None:
    driver = open_driver("ascii", {"prefix": "$M,", "separator": ",", "checksum": checksum})
    text = b"$M,1.5,-2.5,3"
    line = text + b"*" + digits(text).encode()
    assert driver.feed(line + b"\r\n")[0].field == (1.5, -2.5, 3.0)
    wrong = [line.replace(b"1.5", b"1.6"), text, text + b"*", line[:-1], line[:-1] + b"g", b"*"]
    assert driver.feed(b"\n".join(wrong) + b"\n") == []
    assert driver.frames_bad == len(wrong)


def test_a_known_nmea_sentence() -> None:
    # the textbook example of the checksum
    text = "$GPGLL,5300.97914,N,00259.98174,E,125926,A*28\n"
    (reading,) = read(
        text, prefix="$GPGLL,", separator=",", columns=["x", "-", "y", "-", "z", "-"], checksum="nmea"
    )
    assert reading.field == (5300.97914, 259.98174, 125926.0)


def test_counts_sequence_and_supply() -> None:
    columns = ["sequence", "x", "y", "z", "supply", "power_cycle"]
    counts = {"unit": "counts", "scale": -2.0, "range": 100.0, "sequence_modulo": 256, "rate": 10.0}
    driver = open_driver("ascii", {"columns": columns, **counts, "start": ["*99C\r"]})
    (reading,) = driver.feed(b"255 10 -20 50 11.5 3\n")
    assert reading.counts == (10, -20, 50)
    assert reading.field == (-20.0, 40.0, -100.0)
    assert (reading.sequence, reading.supply, reading.power_cycle, reading.saturated) == (255, 11.5, 3, True)
    assert (driver.sequence_modulo, driver.period, driver.range_nt) == (256, 0.1, 100.0)
    assert driver.start() == (b"*99C\r",)


@pytest.mark.parametrize(
    "line",
    ["1 2", "1 2 3 4", "1 2 x", "nan 2 3", "1 2 inf", "1 2 3_0", "1_0 2 3", "1,2,3", "1 2 1e999", "1 2 1e300",
     "\x00 1 2 3", "1 2 \xff"],
)  # fmt: skip
def test_a_line_that_says_something_else_is_bad(line: str) -> None:
    driver = open_driver("ascii", {})
    assert driver.feed(line.encode("latin-1") + b"\n") == []
    assert driver.frames_bad == 1
    assert driver.bytes_skipped == len(line.encode("latin-1"))


@pytest.mark.parametrize("line", ["1 2 3 1e300 4", "1 2 3 4 -1e39", "99999999999 2 3 4 5"])
def test_a_number_that_no_message_holds_is_bad(line: str) -> None:
    options = {"columns": ["x", "y", "z", "temperature", "supply"], "unit": "counts", "scale": 1e-3}
    (reading,) = read(f"{line}\n1 2 3 nan 5\n", **options)
    assert reading.counts == (1, 2, 3)
    assert read("inf 1 2 3\nnan 1 2 3\n", columns=["time", "x", "y", "z"]) == []


def test_other_ends_of_line_and_separators() -> None:
    assert [r.field for r in read("1;2;3\r4;5;6\r", separator=";", terminator="\r")] == [(1, 2, 3), (4, 5, 6)]
    assert [r.field for r in read("1\t 2   3\r\n\r\n\n", separator="")] == [(1, 2, 3)]
    assert len(read("1 2 3 a_b\n", columns=["x", "y", "z", "-"])) == 1
    assert open_driver("ascii", {}).range_nt == inf


def test_an_overlong_line_is_skipped() -> None:
    driver = open_driver("ascii", {})
    assert [r.field for r in driver.feed(b"1 2 " + b"3" * 1000 + b"\n1 2 3\n")] == [(1, 2, 3)]
    assert driver.bytes_skipped == 1004


def test_what_tells_half_a_line_from_a_whole_one_costs_none() -> None:
    driver = open_driver("ascii", {"prefix": "$MAG ", "columns": ["x", "y", "z"]})
    driver.start()
    assert [r.field for r in driver.feed(b"$MAG 1 2 3\n$MAG 4 5")] == [(1, 2, 3)]
    driver.start()  # the line was opened again
    assert [r.field for r in driver.feed(b"8 9\n$MAG 4 5 6\n")] == [(4, 5, 6)]
    assert (driver.frames_bad, driver.bytes_skipped) == (1, 11)


RUNMAG = {"columns": ["x", "y", "z", "temperature"], "keys": ["rx", "ry", "rz", "lt"], "unit": "counts"}


@pytest.mark.parametrize(
    "line",
    [
        b'{ ts:"03 May 2020 23:56:55",  lt:"24.62", x:"14" , y:"-11", rx:"1109", ry:"-844", rz:"3707" }',
        b'{"ts": "2020-05-03T23:56:55Z", "rx": 1109, "ry": -844, "rz": 3707, "lt": 24.62}',
    ],
)
def test_values_are_found_by_their_keys(line: bytes) -> None:
    """Lines of runMag, from its README, and the same as strict JSON in another order."""
    driver = open_driver("ascii", {**RUNMAG, "scale": 13.333})
    driver.start()
    (reading,) = driver.feed(b"rest of a line\n" + line + b"\n")
    assert reading.counts == (1109, -844, 3707)
    assert reading.field == pytest.approx((14_786.3, -11_253.1, 49_425.4), abs=0.1)
    assert reading.temperature == 24.62
    bad = driver.frames_bad
    assert driver.feed(line.replace(b"rz", b"r_") + b"\n") == []
    assert driver.frames_bad == bad + 1


@pytest.mark.parametrize(
    ("line", "options", "total"),
    [
        (
            "*26.150/12:34:56.7 F:050123.456 S:142 D:+001.2m A:003.4 L:0 120ms_Q:07 !!!!",
            {"prefix": "*", "keys": ["F"]},
            50_123.456,
        ),
        ("$ 50123.45  142  0012", {"prefix": "$", "columns": ["total_field", "-", "-"]}, 50_123.45),
        ("$ 49895.131,1249", {"prefix": "$", "separator": ",", "columns": ["total_field", "-"]}, 49_895.131),
        ("142244.0 48464.53 99", {"columns": ["-", "total_field", "-"]}, 48_464.53),
        ("04-22-2015 142244  48464.53 99", {"columns": ["-", "-", "total_field", "-"]}, 48_464.53),
        ('{"Tm": 48.46453}', {"keys": ["Tm"], "unit": "uT"}, 48_464.53),
    ],
)
def test_lines_of_scalar_instruments(line: str, options: dict[str, Any], total: float) -> None:
    driver = open_driver("ascii", {"columns": ["total_field"]} | options)
    gps = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
    (reading,) = driver.feed(gps + line.encode() + b"\r\n")
    assert reading.field == pytest.approx((total, 0.0, 0.0))
    assert reading.counts is not None
    assert reading.counts[0] * driver.nt_per_count == pytest.approx(total, abs=1e-4)
    assert is_scalar(driver)
    assert driver.frames_bad == 1
