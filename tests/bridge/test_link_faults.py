"""Test faults of the link, in sequence, on one bridge that must survive all of them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from math import inf, nan

import numpy as np
import pytest
from checks import NOISE, Measured, replays, soon
from devices import TELEMETRY_HZ
from rig import Rig

from magbridge.mavlink import Codec
from magbridge.records import Quality

REAL32 = 9
Retell = Callable[[bytes], list[bytes]]
"""Function that returns the frames that the link delivers for a telemetry frame."""


def test_garbage_from_the_link(rig: Rig, measured: Measured) -> None:
    rig.until_well()
    before, mark = rig.fresh_status(), rig.mark
    half = rig.autopilot.telemetry()[:20]
    for piece in (NOISE[:1500], half, b"\xfd", b"\xfe" * 300, NOISE[1500:3000]):
        rig.autopilot.send(piece)
    back = rig.until_well()
    after = rig.until_status(
        lambda status: status["link_bytes_skipped"] >= before["link_bytes_skipped"] + 3200
    )
    skipped = after["link_bytes_skipped"] - before["link_bytes_skipped"]
    lost = after["link_frames_lost"] - before["link_frames_lost"]
    rig.until_answered()
    assert rig.undue_flags(mark) == ""
    measured(recovers_s=back, frames_lost=lost, bytes_skipped=skipped)
    assert lost <= 2


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
        (tripled, "", 0, 0, 0.5),
        (shuffled, "", 3, 0, 0.5),  # those that were kept back in the end
        (with_another_vehicle, "vehicle 2 is on the link too: ignored", 0, 0, 0.5),
        (with_another_autopilot, "two autopilots send as 1:1", inf, 1, 6.0),  # two sequences and two clocks
        (with_another_bridge, "another program sends as 1:191", 0, 0, 0.5),
    ],
    ids=["three times", "out of order", "another vehicle", "another autopilot", "another bridge"],
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
    assert [line for line in rig.texts(mark) if "send" in line or "vehicle" in line] == [reported] * bool(
        reported
    )
    measured(noticed_s=noticed, recovers_s=back)
    assert back < soon(within_s)


def test_parameter_out_of_range(rig: Rig) -> None:
    rig.until_well()
    mark = rig.mark
    for value in (0.5, float("nan"), float("inf"), -1.0):
        rig.set_parameter("MB_GAP_FACTOR", value)
    rig.until_reported("MB_GAP_FACTOR: 0.5 is not within 1.01 to 1000", mark)
    rig.until(lambda: len(rig.of("PARAM_VALUE", mark)) == 4)
    assert {message["param_value"] for message in rig.of("PARAM_VALUE", mark)} == {2.5}
    assert rig.undue_flags(mark) == ""
    assert not (rig.folder / "bridge.parameters.json").exists()


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


def test_all_of_it_again_from_the_log(rig: Rig) -> None:
    replays(rig)
