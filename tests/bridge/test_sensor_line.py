"""Test the interpretation of the sensor's line: half a line, rare readings, another instrument."""

from pathlib import Path

import pytest
from fed import FedBridge, named
from small import ASCII_OPTIONS, small_bridge

from magbridge.bridge import events
from magbridge.bridge.sensor import SensorStream
from magbridge.config import Align, Link, Sensor
from magbridge.correction import Correction
from magbridge.link.component import Component
from magbridge.mavlink.enums import MAG_PORT_NAME
from magbridge.records import Channel
from magbridge.sensors.hmr2300 import Hmr2300, Hmr2300Options

LINE = b"12340.5 43210.9 -234.5 4.0 %.1f 7\r\n"


class Bench(FedBridge):
    """Bridge whose sensor's port is open, and the x of each MAG_RAW that it sent."""

    def __init__(self, folder: Path, options: str = ASCII_OPTIONS) -> None:
        super().__init__(small_bridge(folder, ["MAG_RAW"], options=options))
        self.open(0.0)

    def open(self, seconds: float) -> None:
        self.feed(seconds, Channel.STATE, events.port_state(MAG_PORT_NAME.SENSOR))

    def receive(self, seconds: float, data: bytes) -> None:
        self.feed(seconds, Channel.SENSOR, data)

    @property
    def raw(self) -> list[float]:
        return [message["x"] for message in named(self.messages, "MAG_RAW")]


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_half_a_line_is_not_a_sample(bench: Bench) -> None:
    """The bridge uses neither a partial line at its start nor halves from before and after unplugging."""
    whole = LINE % 1.0
    bench.receive(0.1, whole[4:])
    bench.receive(0.2, whole + whole[:9])
    bench.open(1.0)
    bench.receive(1.1, whole[11:])
    bench.receive(1.2, LINE % 2.0)
    assert bench.raw == [12340.5, 12340.5]


def test_an_instrument_that_sends_rarely_is_received_each_time(bench: Bench) -> None:
    """`sensor.timeout` is 10 s: a request to restart costs no reading."""
    for k in range(5):
        bench.receive(15.0 * k, LINE % (15.0 * k))
    assert len(bench.raw) == 4  # the first may have been half a line
    assert "ascii is silent" in bench.texts


def test_a_wrong_rate_is_reported_once(tmp_path: Path) -> None:
    """The instrument sends 15 readings/s, which the bridge must not count as 20 with losses."""
    bench = Bench(tmp_path, 'columns = ["x", "y", "z"], rate = 20.0')
    for k in range(600):
        bench.receive(k / 15.0, b"12340.5 43210.9 %d\r\n" % k)
    assert [text for text in bench.texts if "rate" in text] == ["ascii sends 15 readings/s, but rate = 20"]
    assert [message["samples_lost"] for message in named(bench.messages, "MAG_STATUS")][-1] == 0


GGA = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"


@pytest.mark.parametrize(
    ("line", "what"),
    [
        (GGA, "sends text, but no readings: sensor.options?"),
        (b"nan NaN nan 4.0 1.0 7\r\n", "sends NaN, but no readings"),
        (bytes(range(250, 256)) + b"\r\n", "sends, but no readings: baud rate?"),
    ],
)
def test_an_instrument_with_another_protocol_is_not_silent(bench: Bench, line: bytes, what: str) -> None:
    for k in range(41):
        bench.receive(k, line)
    assert not bench.raw
    assert bench.texts[-1] == f"ascii {what}"
    assert len([text for text in bench.texts if "readings" in text]) == 1
    bench.feed(65.0, Channel.STATE, b"")
    assert bench.texts[-1] == "ascii is silent"


class Commanded(Hmr2300):
    """Driver with given start-up commands."""

    def __init__(self, commands: tuple[bytes, ...]) -> None:
        super().__init__(Hmr2300Options())
        self.start = lambda: commands  # type: ignore[method-assign]


class OpenedLine:
    """Sensor whose port was opened at 0, by the name of its port or by a pattern."""

    def __init__(self, *commands: bytes, port: str = "/dev/ttyUSB0") -> None:
        component, driver = Component(Link("udpout:h:1"), {}, start_us=0), Commanded(commands)
        correction, self._output = Correction(None, Align()), component.output
        self.sensor = SensorStream(
            Sensor("hmr2300", port), driver, correction, component, 0, component.publisher
        )
        self.sensor.opened(0)

    def sent_at(self, now_us: int) -> list[bytes]:
        self._output.advance(now_us)
        sent = list(self.sensor.to_send)
        self.sensor.to_send.clear()
        return sent


@pytest.mark.parametrize(
    ("searching", "received", "sent"),
    [
        (True, GGA[30:] + GGA, []),  # a GPS, in the middle of a sentence
        (True, GGA.replace(b"GPGGA", b"PMAGN"), [1.3]),  # a maker's own sentence: maybe the sensor's
        (True, b"\x00\xff$GPGGA,\x80", [1.3]),  # at another baud rate, at which it reads no commands either
        (True, b"", [1.3]),
        (False, GGA, [0.0]),
    ],
)
def test_a_line_found_by_a_pattern_is_listened_to_before_it_gets_commands(
    searching: bool, received: bytes, sent: list[float]
) -> None:
    line = OpenedLine(b"go", port="/dev/ttyUSB*" if searching else "/dev/ttyUSB0")
    times = []
    for k in range(50):
        times += [0.1 * k for _ in line.sent_at(100_000 * k)]
        if received and k % 10 == 7:
            line.sensor.receive(received[:11], 100_000 * k)
            line.sensor.receive(received[11:], 100_000 * k)
    assert times == pytest.approx(sent, abs=0.11)
    assert line.sensor.wrong_device == (sent == [])


def test_what_turns_out_to_be_a_gps_gets_no_further_commands() -> None:
    line = OpenedLine(b"1", b"2", b"3", port="/dev/ttyUSB*")
    sent = []
    for now_us in range(0, 2_000_000, 10_000):
        sent += line.sent_at(now_us)
        if sent and not line.sensor.wrong_device:
            line.sensor.receive(GGA, now_us)
    assert sent == [b"1"]
    assert line.sensor.wrong_device


def test_commands_are_a_tenth_of_a_second_apart() -> None:
    """An instrument replies to one command before it reads the next."""
    line = OpenedLine(b"1", b"2", b"3")
    for now_us in range(0, 300_000, 10_000):
        expected = {0: [b"1"], 100_000: [b"2"], 200_000: [b"3"]}.get(now_us, [])
        assert line.sent_at(now_us) == expected
