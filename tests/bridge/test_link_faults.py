"""Test faults of the link, in sequence, on one bridge that must survive all of them."""

from __future__ import annotations

import numpy as np
import pytest
from checks import NOISE, Row, replays, seconds, soon
from devices import TELEMETRY_HZ
from rig import Rig

from magbridge.mavlink import Codec
from magbridge.records import Quality

REAL32 = 9
ABSENT_S = 5.0


def test_garbage_from_the_link(rig: Rig, table: Row) -> None:
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
    table(
        "3,300 bytes of noise and half frames from the link",
        "no change and no flag",
        seconds(back),
        f"only the half frame: `link_frames_lost` {lost}, `link_bytes_skipped` {skipped}",
    )
    assert lost <= 2


@pytest.mark.parametrize("how", ["frozen", "gone"])
def test_telemetry_stale(rig: Rig, table: Row, how: str) -> None:
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
    table(
        "telemetry frozen: the same message over and over"
        if how == "frozen"
        else "telemetry stops while the autopilot carries on",
        f"after `max_age` (0.5 s; seen after {noticed:.2f} s) `stale_telemetry`, a growing sigma and "
        "`telemetry_age`, the parameter's bit in `telemetry_stale`, STATUSTEXT",
        seconds(back),
        "nothing",
    )
    assert back < soon(1.0)


def test_telemetry_duplicated(rig: Rig, table: Row) -> None:
    rig.until_well()
    before, mark = rig.fresh_status(), rig.mark
    with rig.autopilot.retelling(lambda frame: [frame] * 3):
        rig.run(0.7)
    rig.run(0.2)
    after = rig.fresh_status()
    assert rig.undue_flags(mark) == ""
    assert after["link_frames_lost"] == before["link_frames_lost"]
    table(
        "every telemetry message arrives three times",
        "no change: the copies are ignored",
        "at once",
        "nothing",
    )


def test_telemetry_out_of_order(rig: Rig, table: Row) -> None:
    rig.until_well()
    before, mark = rig.fresh_status(), rig.mark
    kept: list[bytes] = []

    def shuffle(frame: bytes) -> list[bytes]:
        kept.append(frame)
        if len(kept) < 4:
            return []
        frames, kept[:] = [kept[i] for i in (2, 0, 3, 1)], []
        return frames

    with rig.autopilot.retelling(shuffle):
        rig.run(16 / TELEMETRY_HZ)
    rig.run(0.2)
    after = rig.fresh_status()
    lost = after["link_frames_lost"] - before["link_frames_lost"]
    assert rig.undue_flags(mark) == ""
    assert lost < 4  # those that were kept back in the end
    assert after["vehicle_reboots"] == before["vehicle_reboots"]
    assert not any("two autopilots" in line for line in rig.texts(mark))
    table(
        "telemetry out of order: four messages shuffled",
        "no change: a value older than the newest is ignored",
        "at once",
        "the values that came too late; they are not counted as lost",
    )


def test_second_system_on_the_link(rig: Rig, table: Row) -> None:
    rig.until_well()
    mark = rig.mark
    other = Codec(2, 1)
    shouted = []

    def join(frame: bytes) -> list[bytes]:
        fields = {"value": -900.0, "name": "battpos", "time_boot_ms": 7}
        shouted.append(0)
        return [
            frame,
            other.pack("NAMED_VALUE_FLOAT", **fields),
            other.pack("HEARTBEAT", type=12, autopilot=3),
            other.pack(
                "PARAM_SET", target_system=2, target_component=191, param_id="MB_GAP_FACTOR", param_value=9,
                param_type=REAL32,
            ),
        ]  # fmt: skip

    with rig.autopilot.retelling(join):
        delay = rig.until_reported("vehicle 2 is on the link too: ignored", mark)
        rig.run(0.5)
    assert rig.undue_flags(mark) == ""
    assert not rig.of("PARAM_VALUE", mark)
    fields = np.array([message["total_field"] for message in rig.of("MAG_FIELD", mark)])
    assert np.ptp(fields) < 1.0
    assert len([line for line in rig.texts(mark) if "vehicle 2" in line]) == 1
    assert shouted
    table(
        "a second vehicle on the link whose telemetry has the same names",
        f"STATUSTEXT once (after {delay:.2f} s); its telemetry is ignored",
        "at once",
        "nothing",
    )


def test_two_autopilots_answer(rig: Rig, table: Row) -> None:
    rig.until_well()
    mark = rig.mark
    other, count = Codec(1, 1), 0

    def both(frame: bytes) -> list[bytes]:
        nonlocal count
        count += 1
        # another vehicle, on for a day
        return [frame, other.pack("SYS_STATUS"), other.pack("ATTITUDE", time_boot_ms=86_400_000 + 50 * count)]

    with rig.autopilot.retelling(both):
        delay = rig.until_reported("two autopilots send as 1:1", mark)
    back = rig.until_well()
    assert rig.undue_flags(mark) == ""
    assert np.ptp([message["total_field"] for message in rig.of("MAG_FIELD", mark)]) < 1.0
    assert len([line for line in rig.texts(mark) if "two autopilots" in line]) == 1
    table(
        "two programs answer as the autopilot (1:1)",
        f"STATUSTEXT after {delay:.2f} s; flags: {rig.flags(mark) or 'none'}",
        seconds(back),
        "nothing; `link_frames_lost` grows because their sequence numbers interleave",
    )
    assert back < soon(6.0)


def test_another_bridge_answers(rig: Rig, table: Row) -> None:
    rig.until_well()
    mark = rig.mark
    rig.autopilot.send(Codec(1, 191).pack("HEARTBEAT", type=18, autopilot=8))
    delay = rig.until_reported("another program sends as 1:191", mark)
    back = rig.until_well()
    assert rig.undue_flags(mark) == ""
    table(
        "another program uses the bridge's own address (1:191)",
        f"STATUSTEXT after {delay:.2f} s; its messages are not taken for telemetry",
        "at once",
        "nothing",
    )
    assert back < soon(0.5)


def test_parameter_out_of_range(rig: Rig, table: Row) -> None:
    rig.until_well()
    mark = rig.mark
    for value in (0.5, float("nan"), float("inf"), -1.0):
        rig.autopilot.send_message(
            "PARAM_SET", target_system=1, target_component=191, param_id="MB_GAP_FACTOR", param_value=value,
            param_type=REAL32,
        )  # fmt: skip
    rig.until_reported("MB_GAP_FACTOR: 0.5 is not within 1.01 to 1000", mark)
    rig.until(lambda: len(rig.of("PARAM_VALUE", mark)) == 4)
    assert {message["param_value"] for message in rig.of("PARAM_VALUE", mark)} == {2.5}
    assert rig.undue_flags(mark) == ""
    assert not (rig.folder / "bridge.parameters.json").exists()
    table(
        "a parameter write out of range (also NaN or infinite)",
        "PARAM_VALUE with the value still in force, STATUSTEXT with the limits",
        "at once",
        "the write, which is refused",
    )


def test_autopilot_reboots(rig: Rig, table: Row) -> None:
    rig.until_well()
    before, mark = rig.fresh_status(), rig.mark
    rig.autopilot.reboot()
    rig.until_reported("autopilot 1:1 rebooted", mark)
    back = rig.until_well()
    after = rig.fresh_status()
    assert after["vehicle_reboots"] == before["vehicle_reboots"] + 1
    assert rig.flags(mark) in ("", "stale_telemetry")
    table(
        "autopilot reboots: its clock starts over",
        f"STATUSTEXT, `vehicle_reboots`; flags: {rig.flags(mark) or 'none'}",
        seconds(back),
        "nothing",
    )
    assert back < soon(2.0)


def test_udp_peer_gone_and_back(rig: Rig, table: Row) -> None:
    rig.until_well()
    mark = rig.mark
    last = rig.of("MAG_FIELD")[-1]["sequence"]
    before, made = rig.fresh_status(), rig.fluxgate.encoder.sequence
    rig.autopilot.down()
    rig.run(ABSENT_S + 0.7)
    rig.autopilot.up()
    back = rig.until_well()
    rig.until_reported("autopilot 1:1 found", mark)
    first = next(message for message in rig.of("MAG_FIELD", mark) if message["sequence"] > last + 50)
    after = rig.fresh_status()
    lost = first["sequence"] - last - 1
    came = after["samples"] - before["samples"]
    assert came > lost >= 50 * ABSENT_S  # the bridge went on measuring
    assert came == pytest.approx(rig.fluxgate.encoder.sequence - made, abs=25)  # half a second on the way
    assert after["samples_lost"] == before["samples_lost"]
    table(
        "autopilot link down (UDP: the port closes), up again after 5.7 s",
        'nothing gets through; in the log, `stale_telemetry` after `max_age`, "autopilot 1:1 is silent" '
        "after 5 s",
        seconds(back),
        f"messages to the autopilot, visible in MAG_FIELD's `sequence` ({lost} here); the log has them all",
    )
    assert back < soon(1.5)


def test_all_of_it_again_from_the_log(rig: Rig) -> None:
    replays(rig)
