"""Attack a running bridge from the network, and print the losses of each attack in a table.

    .venv/bin/python tools/attacks.py              all: some minutes
    .venv/bin/python tools/attacks.py header       the attacks with "header" in their names

The bridge runs as a process between an emulated sensor and an emulated autopilot, which sends 200 frames a
second. *In*: the autopilot's frames that the bridge missed, by their sequence numbers. If the attacker
sends as the autopilot, *in* counts rejected frames instead. *Out*: the samples of MAG_FIELD that the
autopilot missed. Attackers without a key can send any data from any address.
"""

from __future__ import annotations

import socket
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

sys.path.append(str(Path(__file__).parents[1] / "tests" / "harness"))

from rig import Rig
from studies import show, table

from magbridge.link.files import FTP_HEADER, Opcode
from magbridge.mavlink import Codec, Signing

KEY = bytes(range(1, 33))
SECONDS = 2.0
"""Duration of each attack, s."""
ALLOWED = 0.01
YEARS_US = 315_576_000_000_000
"""Ten years, µs."""


class Attacker:
    """Attacker with `count` sockets that send to the bridge's link."""

    def __init__(self, rig: Rig, stack: ExitStack, count: int) -> None:
        kind = socket.SOCK_DGRAM
        self.rig = rig
        self.lines = [stack.enter_context(socket.socket(socket.AF_INET, kind)) for _ in range(count)]
        for line in self.lines:
            line.setblocking(False)

    def emit(self, data: bytes, times: int = 1) -> None:
        """Send `data` from each socket, `times` times."""
        for line in self.lines:
            for _ in range(times):
                with suppress(BlockingIOError):
                    line.sendto(data, self.rig.autopilot.address)

    def answered(self) -> int:
        """Return the number of bytes that the bridge sent to the attacker's sockets."""
        total = 0
        for line in self.lines:
            with suppress(OSError):
                while data := line.recv(65536):
                    total += len(data)
        return total


class Attack(NamedTuple):
    """An attack: its link, its number of sockets, and the action at each frame of the autopilot."""

    name: str
    link: str
    strangers: int
    act: Callable[[Attacker, int], None]
    reported: str = ""
    spoofs: bool = False


def frame(system: int, component: int, message: str, /, **fields: Any) -> bytes:
    """Return an unsigned frame of a message from a system and component."""
    return Codec(system, component).pack(message, **fields)


def to_us(**fields: Any) -> dict[str, Any]:
    """Return the fields of a message with the bridge as the target."""
    return {"target_system": 1, "target_component": 191, **fields}


def ftp(opcode: int, data: bytes, sequence: int, size: int = 0) -> bytes:
    """Return the frame of a MAVLink FTP request."""
    header = FTP_HEADER.pack(sequence & 0xFFFF, sequence & 0xFF, opcode, size or len(data), 0, 0, 0)
    payload = (header + data).ljust(251, b"\0")
    return frame(255, 190, "FILE_TRANSFER_PROTOCOL", **to_us(payload=payload))


def signed(component: int, ahead_us: int) -> bytes:
    """Return a frame signed with the right key and a time `ahead_us` ahead."""
    codec = Codec(1, component, Signing(KEY))
    codec.now_us = time.time_ns() // 1000 + ahead_us
    return codec.pack("NAMED_VALUE_FLOAT", name="x", value=1.0)


def recorded_frames(attacker: Attacker, _: int) -> None:
    """Replay the latest frame of the autopilot."""
    attacker.emit(RECORDED[0])


def connect(attacker: Attacker, _: int, words: bytes = b"") -> None:
    """Open five TCP connections, send `words` on each open one, and keep at most 200 open."""
    for _ in range(5):
        line = socket.socket()
        line.setblocking(False)
        with suppress(OSError):
            line.connect(attacker.rig.autopilot.address)
        attacker.lines.append(line)
    for line in attacker.lines:
        with suppress(OSError):
            line.send(words)
    for line in attacker.lines[:-200]:
        line.close()
    del attacker.lines[:-200]


RECORDED = [b""]
HEADER_SIZE = bytes((0xFD, 60, 0, 0, 7, 9, 9, 0xF0, 0xE0, 0))
BEAT = frame(255, 190, "HEARTBEAT", type=6, autopilot=8)
BATTERY = frame(1, 99, "NAMED_VALUE_FLOAT", name="battpos", value=-9.0)
AGE = frame(1, 99, "PARAM_SET", **to_us(param_id="MB_AGE_BATTPOS", param_value=1e6, param_type=9))
OFF = frame(1, 99, "COMMAND_LONG", **to_us(command=511, param1=60101, param2=-1.0))
ATTACKS = (
    Attack("nothing, signed", "signed", 0, lambda _a, _k: None),
    Attack("header of an unknown message before each frame", "signed", 1, lambda a, _: a.emit(HEADER_SIZE)),
    Attack("unsigned heartbeats of 40", "signed", 40, lambda a, _: a.emit(BEAT), "not signed"),
    Attack("an unsigned RADIO_STATUS, which needs no signature", "signed", 1,
           lambda a, _: a.emit(frame(51, 68, "RADIO_STATUS", rssi=80))),
    Attack("frames signed with another key", "signed", 1,
           lambda a, _: a.emit(Codec(1, 1, Signing(bytes(32))).pack("HEARTBEAT", type=12)), "another key"),
    Attack("genuine frames, recorded and sent again", "signed", 1, recorded_frames, "an old time stamp"),
    Attack("a sender with the key, ten years ahead, as 1:25", "signed", 1,
           lambda a, _: a.emit(signed(25, YEARS_US))),
    Attack("a sender with the key, ten years ahead, as the autopilot", "signed", 1,
           lambda a, _: a.emit(signed(1, YEARS_US)), "several addresses", spoofs=True),
    Attack("a sender with the key, an hour behind, as 1:25", "signed", 1,
           lambda a, _: a.emit(signed(25, -3_600_000_000)), "a time stamp behind our clock"),
    Attack("a new key, unasked (SETUP_SIGNING)", "signed", 1,
           lambda a, _: a.emit(frame(255, 190, "SETUP_SIGNING", **to_us(secret_key=KEY[::-1]))),
           "keys come from a file"),
    Attack("nothing, unsigned", "udpin", 0, lambda _a, _k: None),
    Attack("one byte from each of 40", "udpin", 40, lambda a, _: a.emit(b"x")),
    Attack("8,000 datagrams of garbage a second", "udpin", 1, lambda a, _: a.emit(bytes(range(97)), 40)),
    Attack("empty datagrams and one of 60 kB", "udpin", 2,
           lambda a, k: a.emit(b"" if k % 20 else bytes(60_000))),
    Attack("battpos of another component (1:99)", "udpin", 1, lambda a, _: a.emit(BATTERY), "not used"),
    Attack("MB_AGE_BATTPOS = 1e6 from 1:99", "udpin", 1, lambda a, _: a.emit(AGE), "only a station"),
    Attack("MAG_FIELD turned off by 1:99", "udpin", 1, lambda a, _: a.emit(OFF), "may not set a rate"),
    Attack("the list of parameters, asked for 1,000 times a second", "udpin", 1,
           lambda a, _: a.emit(frame(255, 190, "PARAM_REQUEST_LIST", **to_us()), 5)),
    Attack("metadata, asked for 1,000 times a second", "udpin", 1,
           lambda a, _: a.emit(frame(255, 190, "COMMAND_LONG", **to_us(command=512, param1=397)), 5),
           "commands a second"),
    Attack("heartbeats of 200 new stations a second", "udpin", 1,
           lambda a, k: a.emit(frame(200 + k % 50, 1 + k % 200, "HEARTBEAT", type=6, autopilot=8))),
    Attack("files opened without end, and one outside", "udpin", 1,
           lambda a, k: a.emit(ftp(Opcode.OPEN_READ, (b"general.json", b"../key.bin")[k % 2], k)), "refused"),
    Attack("answers to TIMESYNC without a request", "udpin", 1,
           lambda a, k: a.emit(frame(1, 1, "TIMESYNC", tc1=1 + k, ts1=k)), "several addresses", spoofs=True),
    Attack("bursts of a file by 7 at once", "udpin, others", 7,
           lambda a, k: a.emit(ftp(Opcode.OPEN_READ if k < 2 else Opcode.BURST, b"parameter.json", k, 239))),
    Attack("valid heartbeats of 40 stations", "udpin, others", 40,
           lambda a, _: a.emit(BEAT), "more than 8 peers"),
    Attack("reboots of the autopilot that never were", "udpin", 1,
           lambda a, k: a.emit(frame(1, 1, "ATTITUDE", time_boot_ms=k % 4)),
           "several addresses", spoofs=True),
    Attack("1,000 texts a second, to all", "udpin", 1,
           lambda a, k: a.emit(frame(1, 99, "STATUSTEXT", text=f"nothing {k}", severity=2), 5)),
    Attack("commands without end", "udpin", 1,
           lambda a, k: a.emit(frame(255, 190, "COMMAND_LONG", **to_us(command=k % 1000)), 5),
           "commands a second"),
    Attack("our own heartbeat, sent back", "udpin", 1,
           lambda a, _: a.emit(frame(1, 191, "HEARTBEAT", type=18, autopilot=8)), "another program sends"),
    Attack("nothing, by TCP", "tcpin", 0, lambda _a, _k: None),
    Attack("1,000 connections a second", "tcpin", 0, connect),
    Attack("1,000 connections a second, each with half a frame", "tcpin", 0,
           lambda a, k: connect(a, k, BEAT[:-9])),
)  # fmt: skip


def run(rig: Rig, attack: Attack, seconds: float = SECONDS) -> tuple[float, float, int, str]:
    """Run an attack; return the fractions lost in and out, the bytes sent to the attacker, and the report."""
    rig.until_well()
    before, mark, sent, texts = rig.fresh_status(), rig.mark, [0], set(rig.texts())
    with ExitStack() as stack:
        attacker = Attacker(rig, stack, attack.strangers)

        def retell(genuine: bytes) -> list[bytes]:
            for k in range(10):
                attack.act(attacker, sent[0])
                rig.autopilot.send(rig.autopilot.telemetry() if k else genuine)
                sent[0] += 1
            RECORDED[0] = genuine
            return []

        with rig.autopilot.retelling(retell):
            rig.run(seconds)
        after = rig.fresh_status()
        got = attacker.answered()
        for line in attacker.lines:
            line.close()
    samples = {one["sequence"] for one in rig.of("MAG_FIELD", mark)}
    missed = max(samples) - min(samples) + 1 - len(samples)
    counter = "link_refused" if attack.spoofs else "link_frames_lost"
    lost = max(after[counter] - before[counter], 0) / sent[0]
    new = [text for text in rig.texts(mark) if text not in texts or attack.reported in text]
    reported = next((text for text in new if attack.reported and attack.reported in text), "")
    return lost, missed / (len(samples) + missed), got, reported


def main() -> int:
    """Run the attacks that the arguments name; return the exit code."""
    wanted = sys.argv[1:]
    chosen = [one for one in ATTACKS if not wanted or any(part in one.name for part in wanted)]
    columns = ("attack", "link", "lost in", "lost out", "strangers got", "told")
    shown = table("Attacks", *columns, left=("attack", "link", "told"))
    worst = 0
    for link in dict.fromkeys(one.link for one in chosen):
        with tempfile.TemporaryDirectory() as folder:
            key = KEY if link == "signed" else None
            rig = Rig(Path(folder), "udpin" if link == "signed" else link.partition(",")[0], key=key)
            try:
                rig.start()
                for attack in (one for one in chosen if one.link == link):
                    lost, out, got, reported = run(rig, attack)
                    fails = max(lost, out) > ALLOWED and not reported
                    worst += fails
                    row = (f"{lost:.1%}", f"{out:.1%}", f"{got / 1e3:.1f} kB", reported + " FAILS" * fails)
                    shown.add_row(attack.name, link, *row)
                if any(KEY[::-1][:6] in path.read_bytes() for path in rig.logs):
                    worst += 1
                    shown.add_row("the key that was sent is in the log: FAILS", link, "", "", "", "")
            finally:
                rig.close()
                rig.fluxgate.unplug()
    show(shown)
    return int(worst > 0)


if __name__ == "__main__":
    sys.exit(main())
