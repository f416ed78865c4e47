"""Test faults of the link and of the sensor's line, in sequence, on one bridge that must survive all of them.

Every test waits for a normal state, causes a fault, and checks the published messages, the recovery time and
the losses. Then a test replays the log."""

import signal
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from math import inf, isnan, nan
from typing import Any

import numpy as np
import pytest
from checks import NOISE, Measured, replays, soon
from devices import TELEMETRY_HZ, TRUTH, Ear
from rig import OPTIONS, Rig, calibration

from magbridge.calibration.file import save
from magbridge.calibration.model import CalibratedSensor
from magbridge.mavlink import Codec
from magbridge.records import Quality

REAL32 = 9
Retell = Callable[[bytes], list[bytes]]
"""Function that returns the frames that the link delivers for a telemetry frame."""


@pytest.mark.parametrize("how", ["frozen", "gone"])
def test_telemetry_stale(rig: Rig, measured: Measured, how: str) -> None:
    rig.until_well()
    mark = rig.mark
    sigma = rig.of("MAG_FIELD")[-1]["total_field_sigma"]
    # frozen: the same message, with the same time, again and again
    frames = [rig.autopilot.telemetry()] if how == "frozen" else []
    with rig.autopilot.retelling(lambda _: frames):
        noticed = rig.until(lambda: "stale_telemetry" in rig.flags(mark))
        rig.run(0.5)
        status = rig.fresh_status()
        assert status["telemetry_stale"] == 1
        doubtful = rig.of("MAG_FIELD")[-1]
        assert doubtful["total_field_sigma"] > sigma
        assert doubtful["telemetry_age"] > 0.5
    back = rig.until_well()
    rig.until_reported("field: good", mark)
    assert noticed < soon(1.5)
    for message in rig.of("MAG_FIELD", mark):
        assert bool(message["flags"] & Quality.STALE_TELEMETRY) == (message["telemetry_age"] > 0.5)
    assert rig.flags(mark) in ("stale_telemetry", "stale_telemetry moving")
    measured(noticed_s=noticed, recovers_s=back)
    assert back < soon(1.0)


def tripled() -> Retell:
    return lambda frame: [frame] * 3


def among_noise() -> Retell:
    noise = b"".join((NOISE[:1500], b"\xfd", b"\xfe" * 300, NOISE[1500:3000]))
    return lambda frame: [noise[:900], frame[:20], noise[900:], frame]


def shuffled() -> Retell:
    kept: list[bytes] = []

    def shuffle(frame: bytes) -> list[bytes]:
        kept.append(frame)
        if len(kept) < 4:
            return []
        frames, kept[:] = [kept[i] for i in (2, 0, 3, 1)], []
        return frames

    return shuffle


def with_another_vehicle() -> Retell:
    """The other vehicle's telemetry has the same names, and it sets a parameter of its own bridge."""
    other = Codec(2, 1)
    gap = {"target_system": 2, "target_component": 191, "param_id": "MB_GAP_FACTOR", "param_value": 9}
    return lambda frame: [
        frame,
        other.pack("NAMED_VALUE_FLOAT", value=-900.0, name="battpos", time_boot_ms=7),
        other.pack("HEARTBEAT", type=12, autopilot=3),
        other.pack("PARAM_SET", param_type=REAL32, **gap),
    ]


def with_another_autopilot() -> Retell:
    """The other autopilot has been on for a day."""
    other, uptime_ms = Codec(1, 1), count(86_400_000, 50)
    return lambda frame: [
        frame,
        other.pack("SYS_STATUS"),
        other.pack("ATTITUDE", time_boot_ms=next(uptime_ms)),
    ]


def with_another_bridge() -> Retell:
    other = Codec(1, 191)
    return lambda frame: [frame, other.pack("HEARTBEAT", type=18, autopilot=8)]


@pytest.mark.parametrize(
    ("disturbed", "reported", "max_lost", "max_reboots", "within_s"),
    [
        (among_noise, "", 2, 0, 0.5),
        (tripled, "", 0, 0, 0.5),
        (shuffled, "", 3, 0, 0.5),  # those that were kept back in the end
        (with_another_vehicle, "vehicle 2 is on the link too: ignored", 0, 0, 0.5),
        (with_another_autopilot, "two autopilots send as 1:1", inf, 0, 6.0),  # two sequences and two clocks
        (with_another_bridge, "another program sends as 1:191", 0, 0, 0.5),
    ],
    ids=["noise", "three times", "out of order", "another vehicle", "another autopilot", "another bridge"],
)
def test_disturbed_telemetry_changes_no_sample_and_is_reported_once(
    rig: Rig,
    measured: Measured,
    disturbed: Callable[[], Retell],
    reported: str,
    max_lost: float,
    max_reboots: int,
    within_s: float,
) -> None:
    rig.until_well()
    before, mark = rig.fresh_status(), rig.mark
    with rig.autopilot.retelling(disturbed()):
        noticed = rig.until_reported(reported, mark) if reported else nan
        rig.run(16 / TELEMETRY_HZ)
    back = rig.until_well()
    after = rig.fresh_status()
    assert rig.undue_flags(mark) == ""
    assert np.ptp([message["total_field"] for message in rig.of("MAG_FIELD", mark)]) < 1.0
    assert not rig.of("PARAM_VALUE", mark)
    assert after["link_frames_lost"] - before["link_frames_lost"] <= max_lost
    assert after["vehicle_reboots"] - before["vehicle_reboots"] <= max_reboots
    texts = [line for line in rig.texts(mark) if "send" in line or "vehicle" in line]
    assert texts == ([reported] if reported else [])
    measured(noticed_s=noticed, recovers_s=back)
    assert back < soon(within_s)


def test_autopilot_reboots(rig: Rig, measured: Measured) -> None:
    rig.until_well()
    before, mark = rig.fresh_status(), rig.mark
    rig.autopilot.reboot()
    rig.until_reported("autopilot 1:1 rebooted", mark)
    back = rig.until_well()
    after = rig.fresh_status()
    assert after["vehicle_reboots"] == before["vehicle_reboots"] + 1
    assert rig.flags(mark) in ("", "stale_telemetry")
    measured(recovers_s=back)
    assert back < soon(2.0)


# ---- Faults of the sensor's line ---------------------------------------------------------------------------


SILENT, LOST = 2, 3


def test_sensor_unplugged_in_the_middle_of_a_frame(rig: Rig, measured: Measured) -> None:
    rig.until_well()
    before, mark = rig.fresh_status(), rig.mark
    sent = rig.fluxgate.encoder.sequence
    rig.fluxgate.unplug(after=17)
    away = time.monotonic()
    rig.until_status(lambda status: status["sensor_state"] == LOST)
    delay = rig.until_reported("digitizer lost", mark)
    rig.until(lambda: any(beat["system_status"] == 5 for beat in rig.of("HEARTBEAT", mark)))  # critical
    rig.run(0.3)
    rig.fluxgate.plug()
    gone, back = time.monotonic() - away, rig.until_well()
    rig.until_reported("digitizer sends readings", mark)
    after = rig.fresh_status()
    assert rig.undue_flags(mark) == "gap"
    lost = after["samples_lost"] - before["samples_lost"]
    assert lost == pytest.approx(gone * 50, abs=30)
    assert after["sensor_bytes_skipped"] - before["sensor_bytes_skipped"] >= 17
    came = after["samples"] - before["samples"]
    on_the_way = 10 + 50 * rig.machine.seconds(away, time.monotonic())
    assert came + lost == pytest.approx(rig.fluxgate.encoder.sequence - sent, abs=on_the_way)
    measured(recovers_s=back, samples_lost=lost)
    assert delay < soon(1.5)
    assert back < soon(2.0)


def test_sensor_silent(rig: Rig, measured: Measured) -> None:
    rig.until_well()
    before, mark = rig.fresh_status(), rig.mark
    rig.fluxgate.speaks = False
    silent = rig.until_status(lambda status: status["sensor_state"] == SILENT)
    assert before["sample_rate"] > 1.0
    assert isnan(silent["sample_rate"])
    noticed = rig.until_reported("digitizer is silent", mark)
    rig.fluxgate.speaks = True
    back = rig.until_well()
    lost = rig.fresh_status()["samples_lost"] - before["samples_lost"]
    assert rig.undue_flags(mark) == "gap"
    assert lost > 20
    measured(recovers_s=back, samples_lost=lost)
    assert noticed < soon(2.0)
    assert back < soon(1.0)


def test_garbage_from_the_sensor(rig: Rig, measured: Measured) -> None:
    rig.until_well()
    before, mark = rig.fresh_status(), rig.mark
    rig.fluxgate.write(NOISE[:3000])
    back = rig.until_well()
    after = rig.until_status(lambda status: status["sensor_bytes_skipped"] > before["sensor_bytes_skipped"])
    skipped = after["sensor_bytes_skipped"] - before["sensor_bytes_skipped"]
    bad = after["sensor_frames_bad"] - before["sensor_frames_bad"]
    lost = after["samples_lost"] - before["samples_lost"]
    assert 2900 < skipped <= 3000 + 38
    assert lost <= 1
    assert set(rig.undue_flags(mark).split()) <= {"gap"}
    measured(recovers_s=back, samples_lost=lost, frames_bad=bad, bytes_skipped=skipped)
    assert back < soon(0.5)


def test_second_bridge_on_the_same_sensor(rig: Rig) -> None:
    rig.until_well()
    before, mark = rig.fresh_status(), rig.mark
    ear, second = Ear(255), rig.folder / "second"
    second.mkdir()
    text = rig.settings(f"udpout:127.0.0.1:{ear.line.getsockname()[1]}")
    (second / "bridge.toml").write_text(text.replace('"cal.json"', '"../cal.json"'))
    other = rig.spawn(second / "bridge.toml")
    try:
        rig.until(lambda: any("digitizer lost" in one["text"] for one in ear.of("STATUSTEXT")))
    finally:
        other.terminate()
        rig.until(lambda: other.poll() is not None)
        ear.line.close()
    assert other.returncode == 0
    after = rig.fresh_status()
    assert after["samples_lost"] == before["samples_lost"]
    assert after["sensor_bytes_skipped"] == before["sensor_bytes_skipped"]
    assert rig.undue_flags(mark) == ""


def test_sensor_back_under_another_name_and_powered_again(rig: Rig, measured: Measured) -> None:
    rig.until_well()
    mark = rig.mark
    rig.fluxgate.unplug()
    rig.until_status(lambda status: status["sensor_state"] == LOST)
    rig.fluxgate.plug("ttyUSB1", powered_anew=True)
    rig.normal = 32  # offset_suspect: until it is calibrated again
    back = rig.until_well()
    rig.until_reported("offset suspect", mark)
    sigma = rig.of("MAG_FIELD")[-1]["total_field_sigma"]
    assert sigma > 20
    measured(recovers_s=back, sigma_nt=sigma)
    assert back < soon(2.0)


def test_all_of_it_again_from_the_log(rig: Rig) -> None:
    replays(rig)


# ---- The bridge stands still just before a mass moves ------------------------------------------------------


SLOPE = np.array([300.0, -200.0, 100.0])
"""Change of the field as the mass moves from the middle of its range to the end, nT."""
TOTAL = float(np.linalg.norm(TRUTH))
LINES = 'columns = ["x", "y", "z"]'


@pytest.mark.parametrize(
    ("sensor", "answers", "still"),
    [
        (("digitizer", OPTIONS), True, 1.5),
        (("digitizer", OPTIONS), False, 1.5),
        (("ascii", LINES + "\nrate = 4.0"), True, 1.5),
        (("ascii", LINES), False, 2.5),
    ],
)
def test_a_standstill_just_before_a_mass_moves(
    make_rig: Callable[..., Rig], measured: Measured, sensor: tuple[str, str], answers: bool, still: float
) -> None:
    rig = make_rig(sensor=sensor, hz=4.0)
    moved = replace(calibration(tuple(SLOPE.tolist())), sensor=CalibratedSensor(sensor[0]))
    save(moved, rig.folder / "cal.json")
    moves = [np.inf]

    def position(now: float) -> float:
        return 0.5 + 1.5 * float(np.clip(now - moves[0], 0.0, 1.0))

    def field(now: float) -> Any:
        return tuple(np.array(TRUTH) + SLOPE * (position(now) - 0.5) / 1.5)

    rig.autopilot.position, rig.fluxgate.field, rig.autopilot.answers = position, field, answers
    rig.start()
    mark = rig.mark
    rig.process.send_signal(signal.SIGSTOP)
    moves[0] = time.monotonic() + 0.1
    rig.run(still)
    rig.process.send_signal(signal.SIGCONT)
    back = rig.until_well()
    rig.until_reported("stood still for", mark)
    assert [text for text in rig.texts(mark) if "silent" in text] == [], "nobody listened"
    rig.run(0.5)
    samples = rig.of("MAG_FIELD", mark)
    assert len(samples) >= 4 * still
    wrong = 0.0
    for one in samples:
        error = abs(one["total_field"] - TOTAL)
        if one["flags"] == rig.normal:
            assert error <= 3.0 * one["total_field_sigma"], one.fields
        elif one["flags"] & Quality.LATE_JOIN:
            wrong = max(wrong, error / one["total_field_sigma"])
    flagged = sum(bool(one["flags"] & Quality.LATE_JOIN) for one in samples)
    assert flagged >= (4 if not answers or sensor[0] == "ascii" else 0)
    assert wrong < 4.0  # the sigma grows, too
    measured(recovers_s=back, samples=len(samples), samples_flagged=flagged)
    replays(rig)
