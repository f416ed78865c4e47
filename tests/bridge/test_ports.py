"""Test the ports of a link with slow, disturbing and absent readers."""

import fcntl
import os
import select
import socket
import statistics
import sys
import termios
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest
from checks import soon
from devices import serial_line, udp_socket
from machine import standstill

from magbridge.bridge.devices import SerialPort
from magbridge.bridge.events import HostClock, LiveEdge
from magbridge.bridge.links import TcpServer, open_link
from magbridge.bridge.port import MAX_WAIT_S, Peers
from magbridge.errors import ConfigError, PortError
from magbridge.mavlink import Codec, Message, Signing
from magbridge.records import Channel, Reading
from magbridge.sensors import open_driver
from magbridge.sensors.clock import DeviceClock

FRAME = bytes(range(200)) * 5
BEAT = Codec(1, 1).pack("HEARTBEAT", type=12)


def waiting(terminal: int) -> int:
    """Return the number of bytes that a terminal holds for its reader."""
    return int.from_bytes(fcntl.ioctl(terminal, termios.FIONREAD, bytes(4)), sys.byteorder)


def drained(reader: socket.socket, size: int) -> bytes:
    """Read at least `size` bytes."""
    data = b""
    reader.settimeout(10)
    while len(data) < size:
        data += reader.recv(1 << 20)
    return data


def test_a_slow_reader_loses_whole_messages_and_stalls_no_other() -> None:
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        server.bind(("127.0.0.1", 0))
        server.listen()
        port = open_link(f"tcp:127.0.0.1:{server.getsockname()[1]}", 0)
        port.open()
        reader, _ = server.accept()
        count, slowest, machine = 0, 0.0, standstill()
        while port.dropped < 10 * len(FRAME):
            begun = time.monotonic()
            port.write(FRAME)
            took = time.monotonic() - begun
            slowest = max(slowest, took - machine.seconds(begun, begun + took))
            count += 1
            assert count * len(FRAME) < 64 << 20
        taken = count * len(FRAME) - port.dropped
        assert slowest < soon(0.5)
        received = b""
        while len(received) < taken:
            received += drained(reader, 1)
            port.flush()
        assert received == FRAME * (taken // len(FRAME))
        port.close()
        reader.close()


def sample(codec: Codec, count: int) -> bytes:
    """Return the messages that are sent with a sample now."""
    us = time.monotonic_ns() // 1000
    return b"".join(
        [
            codec.pack("MAG_FIELD", time_usec=us, sequence=count, total_field=5e4, total_field_sigma=1.0),
            codec.pack("NAMED_VALUE_FLOAT", time_boot_ms=us // 1000, name="mag_total", value=5e4),
            codec.pack("NAMED_VALUE_FLOAT", time_boot_ms=us // 1000, name="mag_sigma", value=1.0),
            *([codec.pack("STATUSTEXT", text=f"{count}")] if count % 100 == 0 else []),
        ]
    )


def test_a_saturated_line_carries_what_is_new() -> None:
    """Read a pty at half the rate of the writer; measure the age of the data once it has been full."""
    baud, codec, reader = 230_400, Codec(1, 191), Codec(255, 190)
    late: list[tuple[float, float]] = []
    with serial_line() as (master, name), closing(SerialPort(name, baud)) as port:
        port.open()
        for count in range(200):
            port.write(sample(codec, count))
        begun = last = time.monotonic()
        free, count = 0.0, 200
        while last < begun + 2.0:
            now = time.monotonic()
            free, last = min(free + (now - last) * baud / 10, 5000.0), now
            while now > begun + (count - 200) * 0.0025:  # also those that were due while the machine was busy
                port.write(sample(codec, count := count + 1))
            port.flush()
            if free > 100 and select.select([master], [], [], 0)[0]:
                data = os.read(master, int(free))
                free -= len(data)
                fields = [one for one in reader.parse(data) if one.name == "MAG_FIELD"]
                late += [(now, now - one["time_usec"] * 1e-6) for one in fields]
            time.sleep(0.001)
    assert reader.bytes_skipped == 0
    assert port.overrun > 10_000
    assert statistics.median(age for when, age in late if when > begun + 1.5) < 0.3


@pytest.mark.parametrize("key", [None, bytes(32)])
def test_what_waits_for_a_slow_reader(key: bytes | None) -> None:
    """Only the newest sample of each message and name, but all texts, in the order of their signatures."""
    codec, reader = (Codec(*who, Signing(key) if key else None) for who in ((1, 191), (255, 190)))
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = open_link(f"tcp:127.0.0.1:{server.getsockname()[1]}", 0)
        port.open()
        client = server.accept()[0]
    count = 0
    while not port.overrun:
        codec.now_us = time.time_ns() // 1000
        port.write(sample(codec, count := count + 1))
    time.sleep(2 * MAX_WAIT_S)
    reported = count
    while count < reported + 5 or count % 100 == 0:  # no text at the end
        port.write(sample(codec, count := count + 1))
    received: list[Message] = []
    reader.now_us = codec.now_us
    while len(received) < 3 or received[-3].name != "MAG_FIELD" or received[-3]["sequence"] < count:
        port.flush()
        received += reader.parse(drained(client, 1))
    client.close()
    port.close()
    assert reader.bytes_skipped == 0
    assert all(one.known for one in received)
    fields = [one["sequence"] for one in received if one.name == "MAG_FIELD"]
    assert fields == sorted(fields)
    assert fields[-1] == count
    assert len(fields) < reported
    names = [one["name"] for one in received if one.name == "NAMED_VALUE_FLOAT"]
    assert names[-2:] == ["mag_total", "mag_sigma"]
    assert [one["text"] for one in received if one.name == "STATUSTEXT"] == [
        f"{number}" for number in range(100, count + 1, 100)
    ]


def test_a_backlog_of_a_line_is_read_at_once() -> None:
    """Without a device clock, only the last reading of a backlog shows its time; no reading is lost."""
    driver = open_driver("ascii", {"columns": ["x", "y", "z"], "rate": 100.0})
    clock = DeviceClock.for_driver(driver)
    stamps: list[Reading] = []
    with serial_line() as (master, name), closing(SerialPort(name, 9600)) as port:
        port.open()
        for count in [1] * 200 + [320] + [1] * 200:  # 3.2 s and 10 kB, as when the bridge stood still
            os.write(master, b"+20000.000 +1000.000 +40000.000\n" * count)
            while count > 1 and waiting(port.fds()[0]) < 4095:  # a terminal holds no more; the rest follows
                time.sleep(0.001)
            taken = len(stamps) + count
            while len(stamps) < taken:
                assert select.select(port.fds(), [], [], 5.0)[0]
                stamps += clock.stamp(driver.feed(port.read()), taken * 10_000)
    assert {stamp.missing for stamp in stamps} == {0}
    assert not clock.stepped
    assert max(abs(stamp.time_us - 10_000 * (k + 1)) for k, stamp in enumerate(stamps)) <= 4


def test_a_serial_line_behind_a_socket() -> None:
    """Read in pieces as they come; the reason for a closed port is short, without its name again."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = SerialPort(f"socket://127.0.0.1:{server.getsockname()[1]}", 9600)
        port.open()
        device = server.accept()[0]
    device.sendall(FRAME)
    assert select.select(port.fds(), [], [], 5)[0]
    assert port.read() == FRAME
    device.close()
    assert select.select(port.fds(), [], [], 5)[0]
    with pytest.raises(PortError, match="hung up"):
        port.read()
    with pytest.raises(PortError) as refused:
        port.open()
    assert refused.value.reason == "Connection refused"


def test_a_server_takes_the_next_client() -> None:
    port = open_link("tcpin:127.0.0.1:0", 0)
    assert isinstance(port, TcpServer)
    port.open()
    with socket.socket(fileno=socket.dup(port.fds()[0])) as listener:
        address = listener.getsockname()
    port.write(b"nobody hears this")
    assert port.dropped == 17
    for word in (BEAT, BEAT * 2):
        with socket.create_connection(address) as client:
            client.sendall(word)
            received = b""
            while received != word:
                assert select.select(port.fds(), [], [], 5)[0]
                received += port.read()
            port.write(b"answer")
            assert drained(client, 6) == b"answer"
        assert port.is_open
    port.close()
    assert not port.is_open


@pytest.mark.parametrize("kinds", [("udpin", "udpout"), ("tcpin", "tcp")])
@pytest.mark.parametrize(
    ("host", "to"), [("[::1]", "[::1]"), ("[::]", "127.0.0.1"), ("localhost", "127.0.0.1")]
)
def test_a_link_by_ipv6_and_by_both(kinds: tuple[str, str], host: str, to: str) -> None:
    """A station that listens to all of IPv6 receives IPv4, too; a name that is both means IPv4."""
    here = open_link(f"{kinds[0]}:{host}:0", 0)
    try:
        here.open()
    except PortError as error:
        pytest.skip(f"no IPv6 here: {error.reason}")
    with socket.socket(fileno=os.dup(here.fds()[0])) as listener:
        there = open_link(f"{kinds[1]}:{to}:{listener.getsockname()[1]}", 0)
    there.open()
    received = b""
    for one, other in ((there, here), (here, there)):
        one.write(BEAT)
        while not received:
            assert select.select(other.fds(), [], [], 5)[0]
            received = other.read()
        assert received == BEAT
        received = b""
    here.close()
    there.close()


NO_ADDRESSES = (
    "udpin:14550 tcp:host:http tcp:host:70000 tcp:host:1\N{SUPERSCRIPT TWO} tcp:a..b:5760 udpin:::1:14550 "
    "udpin:[::g]:14550 udpout:host:0 socket://host rfc2217://host:70000"
)
NO_DEVICES = "foo://x serial: f.o://x serial:ttyUSB0 serial:/"
NO_KINDS = ["udpot:192.0.2.1:14550", "http:example", "nonsense", "ttyUSB0", "192.0.2.1:14550", __file__, ""]


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        *((url, "HOST:PORT") for url in NO_ADDRESSES.split()),
        *((url, r"link.url: expected a device .*, socket://, rfc2217:// or") for url in NO_DEVICES.split()),
        *((url, "expected udpin, udpout, tcp, tcpin or a serial device") for url in NO_KINDS),
    ],
)
def test_a_url_without_a_valid_kind_address_or_device_is_refused(url: str, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        open_link(url, 0)


def test_a_port_that_cannot_be_opened_says_why(tmp_path: Path) -> None:
    for name in (str(tmp_path / "ttyUSB*"), str(tmp_path / "ttyUSB0")):
        with pytest.raises(PortError, match=r"[Nn]o such (device|file)"):
            open_link(name, 9600).open()


class Unresolved(TcpServer):
    """Link to a host name whose look-up fails after a delay."""

    asked = 0

    def open(self) -> None:
        """Try to open the link without an end."""
        self.asked += 1
        threading.Event().wait()


def test_a_link_that_takes_its_time_to_open_holds_up_neither_the_sensor_nor_the_end() -> None:
    with serial_line() as (_, name):
        link, sensor = Unresolved("tcpin:", ("", 0), Peers()), SerialPort(name, 9600)
        edge = LiveEdge({Channel.LINK: link, Channel.SENSOR: sensor}, HostClock())
        deadline = time.monotonic() + 10.0
        while not sensor.is_open:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        edge.close()
    assert (link.asked, sensor.is_open) == (1, False)


def test_an_impatient_user_stops_it_twice() -> None:
    """The second Ctrl-C may come while the log is being closed."""
    edge = LiveEdge({}, HostClock())
    edge.stop()
    assert list(edge.events(lambda: 0)) == []
    edge.close()
    edge.stop()


# ---- a link by UDP -----------------------------------------------------------------------------------------


def test_a_udp_peer_that_is_not_there_is_no_fault() -> None:
    with udp_socket() as gone:
        port = open_link(f"udpout:127.0.0.1:{gone.getsockname()[1]}", 0)
    port.open()
    for _ in range(20):
        port.write(b"x")
    assert port.dropped > 0
    assert port.read() == b""
    assert port.is_open
    port.close()


def test_what_is_sent_at_once_after_a_standstill_goes_in_datagrams_that_a_network_takes() -> None:
    codec, data = Codec(1, 191), b""
    while len(data) < 100_000:
        data += codec.pack("MAG_FIELD", total_field=5e4, latency=1.0)
    with udp_socket(5.0) as peer:
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        port = open_link(f"udpout:127.0.0.1:{peer.getsockname()[1]}", 0)
        port.open()
        port.write(data)
        datagrams: list[bytes] = []
        while sum(map(len, datagrams)) < len(data):
            datagrams.append(peer.recv(1 << 16))
        assert (port.is_open, port.dropped) == (True, 0)
        port.close()
    assert b"".join(datagrams) == data
    assert max(map(len, datagrams)) <= 1400
    assert all(datagram[0] == 0xFD for datagram in datagrams)


def test_datagrams_that_waited_come_at_once() -> None:
    """After a pause, the bridge reads the telemetry before it processes the samples."""
    with udp_socket() as peer:
        port = open_link(f"udpout:127.0.0.1:{peer.getsockname()[1]}", 0)
        port.open()
        port.write(b"hello")
        _, bridge = peer.recvfrom(10)
        for k in range(200):
            peer.sendto(bytes((k,)) * 600, bridge)
        received = [port.read() for _ in range(3)]
        for data in (b"first", b"", b"after an empty one"):
            peer.sendto(data, bridge)
        assert port.read() == b"firstafter an empty one"
        port.close()
    assert [len(data) for data in received] == [66_000, 54_000, 0]
    assert b"".join(received)[::600] == bytes(range(200))
