"""Test the device clock against simulated truth: drift, jitter, wraps, restarts, steps, losses."""

from collections.abc import Sequence
from itertools import pairwise
from math import nan
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magbridge.arrays import FloatArray
from magbridge.records import Reading
from magbridge.sensors.clock import DeviceClock

EPOCH = 1_700_000_000_000_000


def arrivals(true: FloatArray, jitter: float, seed: int = 1) -> FloatArray:
    """Return arrival times, s: exponential delays of mean `jitter`, in the order of sending."""
    random = np.random.default_rng(seed)
    arrived: FloatArray = np.maximum.accumulate(true + random.exponential(jitter, true.size))
    return arrived


class Stamp(NamedTuple):
    """What the clock finds out about one reading."""

    time_us: int
    restarted: bool
    stepped: bool
    missing: int


def update(clock: DeviceClock, device_time: float, arrival_us: int, sequence: int | None = None) -> Stamp:
    reading = clock.update(Reading((0.0, 0.0, 0.0), None, sequence, device_time), arrival_us)
    return Stamp(reading.time_us, reading.restarted, clock.stepped, reading.missing)


def stamps(
    clock: DeviceClock, device: FloatArray, arrived: FloatArray, sequence: list[int] | None = None
) -> list[Stamp]:
    times = (arrived * 1e6).astype(int) + EPOCH
    numbers: Sequence[int | None] = sequence or [None] * device.size
    rows = zip(device.tolist(), times.tolist(), numbers, strict=True)
    return [update(clock, *row) for row in rows]


def chunk(clock: DeviceClock, readings: list[Reading], arrival_us: int) -> list[Stamp]:
    stamped = clock.stamp(readings, arrival_us)
    return [Stamp(one.time_us, one.restarted, clock.stepped, one.missing) for one in stamped]


def error_us(made: list[Stamp], true: FloatArray) -> FloatArray:
    error: FloatArray = np.array([stamp.time_us - EPOCH for stamp in made]) - true * 1e6
    return error


def flags(made: list[Stamp]) -> tuple[int, int, int]:
    return sum(s.restarted for s in made), sum(s.stepped for s in made), sum(s.missing for s in made)


# The shortest delay in a block of n readings is jitter / n on average; that is the bias that remains, and its
# scatter is as large. Bounds are five times that.
@pytest.mark.parametrize(
    ("rate", "duration", "bound"), [(0.25, 14_400, 5_000), (10.0, 1_200, 800), (100.0, 300, 150)]
)
@pytest.mark.parametrize("drift_ppm", [50.0, -50.0, 2_000.0])
def test_drift_is_learned_and_jitter_removed(
    rate: float, duration: float, bound: float, drift_ppm: float
) -> None:
    true = np.arange(0.0, duration, 1.0 / rate)
    clock = DeviceClock()
    made = stamps(clock, true / (1.0 + drift_ppm * 1e-6) + 77.7, arrivals(true, 5e-3))
    settled = error_us(made, true)[true.size // 4 :]
    assert np.abs(settled).max() < bound
    assert settled.std() < bound / 5
    assert clock.drift_ppm == pytest.approx(drift_ppm, abs=5.0)
    assert flags(made) == (0, 0, 0)


def test_even_at_first_no_error_exceeds_the_arrival_s() -> None:
    true = np.arange(0.0, 20.0, 0.01)
    arrived = arrivals(true, 5e-3)
    made = stamps(DeviceClock(), true * (1 - 50e-6), arrived)
    late = (arrived - true) * 1e6
    assert np.abs(error_us(made, true)).max() <= late.max() + 4
    # after its arrival only where time must not run back
    assert np.mean(error_us(made, true) > late + 4) < 0.01
    assert np.abs(error_us(made, true)[500:]).max() < 400  # after 5 s


def test_a_clock_that_wraps() -> None:
    modulo = 2**32 * 1e-6
    true = np.arange(0.0, 10_000.0, 1.0)
    true = np.delete(true, slice(3_000, 9_500))  # silent for longer than a turn
    made = stamps(
        DeviceClock(time_modulo=modulo), (true * (1 - 50e-6) + 4_000) % modulo, arrivals(true, 5e-3)
    )
    assert flags(made) == (0, 0, 0)
    assert np.abs(error_us(made, true)[200:]).max() < 20_000


@pytest.mark.parametrize("modulo", [0.0, 2**32 * 1e-6])
@pytest.mark.parametrize("uptime", [3.0, 600.0, 3_900.0])
def test_a_power_cycle(modulo: float, uptime: float) -> None:
    before = np.arange(0.0, 60.0, 0.1)
    after = 62.5 + np.arange(0.0, 60.0, 0.1)
    device = np.concatenate([before + uptime, after - 62.5 + 0.3]) * (1 - 50e-6)
    true = np.concatenate([before, after])
    made = stamps(DeviceClock(time_modulo=modulo), device, arrivals(true, 5e-3), [*range(600), *range(600)])
    assert [k for k, stamp in enumerate(made) if stamp.restarted] == [600]
    assert flags(made)[1:] == (0, 0)
    error = error_us(made, true)
    assert np.abs(error[600:620]).max() < 40_000
    assert np.abs(error[700:]).max() < 2_000


@pytest.mark.parametrize("step", [3_600.0, 2.0, -2.0, -3_600.0])
def test_the_host_s_clock_is_set(step: float) -> None:
    true = np.arange(0.0, 240.0, 0.1)
    host = true + np.where(true < 120.0, 0.0, step)
    made = stamps(DeviceClock(), true * (1 + 50e-6), arrivals(true, 5e-3) + host - true)
    (found,) = [k for k, stamp in enumerate(made) if stamp.stepped]
    # back is impossible, and seen at once; forward may be a long delay, until all of two blocks are late
    assert 1200 <= found <= (1200 if step < 0 else 1200 + 2 * 64)
    assert flags(made)[0] == 0
    error = error_us(made, host)
    assert np.abs(error[300:1200]).max() < 2_000
    assert np.abs(error[found + 50 :]).max() < 3_000
    # until then the readings keep the old time, without a jump between them
    assert np.abs((error + (host - true) * 1e6)[1200:found]).max(initial=0) < 2_000


def test_the_instrument_s_clock_is_set_forward() -> None:
    true = np.arange(0.0, 100.0, 0.1)
    made = stamps(DeviceClock(), true + np.where(true < 50.0, 0.0, 1.7e9), arrivals(true, 5e-3))
    assert [k for k, stamp in enumerate(made) if stamp.stepped] == [500]
    assert flags(made)[0] == 0


def test_a_stalled_host_changes_nothing() -> None:
    true = np.arange(0.0, 200.0, 0.01)
    arrived = arrivals(true, 2e-3)
    arrived[(true > 100.0) & (arrived < 101.5)] = 101.5
    made = stamps(DeviceClock(), true, arrived)
    assert flags(made) == (0, 0, 0)
    assert np.abs(error_us(made, true)[5_000:]).max() < 150


def test_a_host_that_is_busy_for_a_second_has_not_set_its_clock() -> None:
    """Nor has the instrument: readings that come late for that long were sent in time."""
    true = np.arange(0.0, 20.0, 0.02)
    made = stamps(
        DeviceClock(), true, arrivals(true, 2e-3) + np.where((true > 5.0) & (true < 6.0), 0.07, 0.0)
    )
    assert flags(made) == (0, 0, 0)
    assert np.abs(error_us(made, true)[50:]).max() < 3_000


# -- without a clock -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate", "error_of_period"), [(0.25, 1e-4), (10.0, 0.01), (20.0, -0.02), (154.0, 0.005)]
)
def test_a_steady_beat_is_a_clock(rate: float, error_of_period: float) -> None:
    true = np.arange(0.0, max(120.0, 400 / rate), 1.0 / rate)
    clock = DeviceClock(period=(1.0 + error_of_period) / rate)
    made = stamps(clock, np.full(true.size, nan), arrivals(true, 2e-3))
    assert flags(made) == (0, 0, 0)
    settled = error_us(made, true)[true.size // 3 :]
    assert np.abs(settled).max() < 3_000
    assert settled.std() < 600
    expected = (1.0 / (1.0 + error_of_period) - 1.0) * 1e6
    assert clock.drift_ppm == pytest.approx(expected, abs=10)


@pytest.mark.parametrize(("rate", "jitter"), [(0.25, 5e-3), (10.0, 1e-3), (154.0, 1e-3)])
def test_unseen_losses_are_counted(rate: float, jitter: float) -> None:
    true = np.arange(30_000 if rate > 1 else 1_000) / rate
    lost = [int(true.size * part) for part in (0.4, 0.6, 0.8)]
    true = np.delete(true, lost)
    made = stamps(DeviceClock(period=1.0 / rate), np.full(true.size, nan), arrivals(true, jitter))
    assert flags(made) == (0, 0, 3)
    error = error_us(made, true)[true.size // 3 :]
    assert np.abs(error).max() < 1.05e6 / rate + 5_000  # at worst a period late, until the block ends
    assert np.median(np.abs(error)) < 3_000


@pytest.mark.parametrize(
    ("rate", "jitter"), [(1.0, 8e-3), (10.0, 1e-3), (20.0, 8e-3), (154.0, 1e-3), (1e3, 0.0)]
)
@pytest.mark.parametrize("delay", [0.38, 5.0])
@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_readings_that_waited_are_not_lost(rate: float, jitter: float, delay: float, lost: float) -> None:
    """They arrive one by one, 0.1 ms apart; some of them may be lost, which shows after the last one."""
    true = np.arange(0.0, max(20.0, 400.0 / rate), 1.0 / rate)
    start = 0.6 * true[-1]
    waited = (true >= start) & (true < start + delay)
    arrived = arrivals(true, jitter)
    arrived[waited] = start + delay + 1e-4 * np.arange(waited.sum())
    kept = ~waited | (np.random.default_rng(1).random(true.size) >= lost)
    true, arrived = true[kept], np.maximum.accumulate(arrived)[kept]
    clock = DeviceClock(period=1.0 / rate)
    made = [clock.update(Reading((0.0, 0.0, 0.0)), EPOCH + round(1e6 * time)) for time in arrived.tolist()]
    error = np.array([reading.time_us - EPOCH for reading in made]) - 1e6 * true
    assert sum(reading.missing for reading in made) - clock.invented == np.count_nonzero(~kept)
    assert clock.rate == pytest.approx(rate)
    assert abs(clock.drift_ppm) < 200.0
    burst = (true >= start) & (arrived - true > 1.0 / rate + 12.0 * jitter)
    last = int(np.flatnonzero(burst)[-1]) if burst.any() else 0
    assert np.abs(error[last + 10 :]).max() < 2e6 * max(jitter, 1e-4)
    wrong = np.abs(error) > 0.5e6 / rate + 2e4
    assert all(reading.since_us for reading, is_wrong in zip(made, wrong, strict=True) if is_wrong)
    if not lost:  # the first ones still look as if others before them were lost
        assert np.count_nonzero(wrong) <= 3 + 0.004 * waited.sum()


@pytest.mark.parametrize(("rate", "jitter"), [(20.0, 8e-3), (50.0, 1e-3), (154.0, 1e-3), (1e3, 0.0)])
def test_losses_do_not_look_like_jitter(rate: float, jitter: float) -> None:
    """A tenth of the readings is lost; uncounted losses must not let later ones pass as long delays."""
    numbers = np.flatnonzero(np.random.default_rng(1).random(round(60 * rate)) > 0.1)
    true = (numbers - numbers[0]) / rate
    clock = DeviceClock(period=1.0 / rate)
    made = stamps(clock, np.full(true.size, nan), arrivals(true, jitter))
    lost = numbers[-1] - numbers[0] + 1 - numbers.size
    assert sum(stamp.missing for stamp in made) - clock.invented == pytest.approx(lost, rel=0.03)
    error = error_us(made, true)[true.size // 4 :]
    assert np.median(np.abs(error)) < 3e3
    assert np.quantile(np.abs(error), 0.97) < 1.03e6 / rate + 10e3
    assert np.abs(error).max() < 0.25e6
    assert abs(clock.drift_ppm) < 100


def test_an_irregular_instrument_is_dated_by_arrival() -> None:
    clock = DeviceClock()
    times = [update(clock, nan, EPOCH + t).time_us - EPOCH for t in (0, 70_003, 70_003, 90_000)]
    assert times == [0, 70_000, 70_004, 90_000]


# -- sequence, chunks, records -------------------------------------------------------------------------------


@pytest.mark.parametrize(("modulo", "numbers", "missing"), [
    (0, [1, 2, 5, 6], [0, 0, 2, 0]),
    (256, [254, 255, 0, 3], [0, 0, 0, 2]),
    (256, [7, 7, 6, 7], [0, 0, 0, 0]),
])  # fmt: skip
def test_holes_in_the_sequence(modulo: int, numbers: list[int], missing: list[int]) -> None:
    clock = DeviceClock(sequence_modulo=modulo)
    assert [update(clock, k, EPOCH + k * 1_000_000, n).missing for k, n in enumerate(numbers)] == missing


@pytest.mark.parametrize("device", [True, False])
def test_readings_of_one_chunk_are_as_good_as_one_by_one(device: bool) -> None:
    true = np.arange(0.0, 60.0, 0.1)
    clock = DeviceClock(period=0.0 if device else 0.1)
    made: list[Stamp] = []
    for start in range(0, 600, 10):
        times = true[start : start + 10]
        readings = [Reading((0.0, 0.0, 0.0), device_time=float(t) if device else nan) for t in times]
        made += chunk(clock, readings, EPOCH + int(times[-1] * 1e6) + 2_000)
    assert flags(made) == (0, 0, 0)
    assert np.abs(error_us(made, true) - 2_000).max() < 10


@pytest.mark.parametrize("piece", [30, 107, 200])
def test_a_backlog_in_pieces_is_dated_as_before(piece: int) -> None:
    """What waited while the host stood still: a terminal hands it on in pieces, each late to its very end."""
    true = np.arange(0.0, 10.0, 0.01)
    readings = [Reading((0.0, 0.0, 0.0), device_time=float(t)) for t in true]
    clock = DeviceClock()
    made = [chunk(clock, [reading], EPOCH + int(reading.device_time * 1e6))[0] for reading in readings[:600]]
    for begin in range(600, 1000, piece):
        made += chunk(clock, readings[begin : begin + piece], EPOCH + 10_000_000 + begin)
    assert flags(made) == (0, 0, 0)
    assert np.abs(error_us(made, true)).max() < 10


EVENTS: Any = st.tuples(
    st.one_of(st.just(nan), st.floats(0, 5_000), st.floats(-1e9, 1e10)),
    st.integers(-(10**7), 10**8),
    st.one_of(st.none(), st.integers(0, 65_535)),
)


@given(st.lists(EVENTS, max_size=60), st.sampled_from([0.0, 4294.967296]), st.sampled_from([0.0, 0.1]))
@settings(max_examples=100)
def test_anything_gives_a_time_that_increases_unless_stepped(
    events: list[tuple[float, int, int | None]], modulo: float, period: float
) -> None:
    clocks = [DeviceClock(time_modulo=modulo, sequence_modulo=65_536, period=period) for _ in range(2)]
    made, arrival = [], EPOCH
    for device_time, wait, sequence in events:
        arrival += wait
        first, second = (update(clock, device_time, arrival, sequence) for clock in clocks)
        assert first == second
        made.append(first)
    assert all(stamp.time_us % 4 == 0 and stamp.missing >= 0 for stamp in made)
    assert all(b.stepped or b.time_us > a.time_us for a, b in pairwise(made))


@pytest.mark.parametrize("away", [3.0, 32.0, 40.0, 65.5, 70.0, 400.0, 3_600.0])
def test_losses_are_exact_however_often_the_sequence_has_wrapped(away: float) -> None:
    """1 kHz and 16 bits: a turn is 65.5 s."""
    numbers = np.concatenate([np.arange(2_000), 2_000 + round(away * 1e3) + np.arange(50)])
    true: FloatArray = numbers * 1e-3
    device = true * (1 - 50e-6)
    clock = DeviceClock(time_modulo=2**32 * 1e-6, sequence_modulo=65_536)
    made = stamps(clock, device, arrivals(true, 5e-3), (numbers % 65_536).tolist())
    assert sum(stamp.missing for stamp in made) == round(away * 1e3)


def test_the_count_stays_exact_over_many_turns_losses_and_doubles() -> None:
    rng = np.random.default_rng(3)
    numbers = np.arange(20_000)
    numbers = numbers[rng.random(numbers.size) > 0.02]
    sent = np.repeat(numbers, np.where(rng.random(numbers.size) < 0.005, 2, 1))
    clock, arrived = DeviceClock(sequence_modulo=256), arrivals(np.asarray(0.1 * sent), 5e-3)
    made = stamps(clock, np.full(sent.size, nan), arrived, (sent % 256).tolist())
    assert sum(stamp.missing for stamp in made) == numbers[-1] + 1 - numbers.size - numbers[0]


def test_with_a_time_and_a_rate_no_number_is_needed_to_count_losses() -> None:
    true = np.delete(np.arange(0.0, 60.0, 0.1), slice(200, 250))
    made = stamps(DeviceClock(period=0.1), true, arrivals(true, 2e-3))
    assert [k for k, stamp in enumerate(made) if stamp.missing] == [200]
    assert made[200].missing == 50


def test_a_shift_of_the_phase_is_followed() -> None:
    """By less than a reading, so none is missing; stamps must not stay early by it."""
    true = np.concatenate([np.arange(0.0, 60.0, 1.0), 60.3 + np.arange(0.0, 400.0, 1.0)])
    made = stamps(DeviceClock(period=1.0), np.full(true.size, nan), arrivals(true, 2e-3))
    assert sum(stamp.missing for stamp in made) == 0
    assert np.abs(error_us(made, true)[-100:]).max() < 20_000


@pytest.mark.parametrize("delay", [0.05, 0.087, 0.096])
def test_a_late_line_is_not_a_missing_reading(delay: float) -> None:
    """At 10 Hz, a line every 7 s arrives late by most of a period; no reading is younger than its arrival."""
    true = np.arange(0.0, 60.0, 0.1)
    late = np.where(np.arange(true.size) % 70 == 69, delay, 0.0)
    arrived = arrivals(true + late, 3e-4)
    made = stamps(DeviceClock(period=0.1), np.full(true.size, nan), arrived)
    assert flags(made) == (0, 0, 0)
    assert (error_us(made, arrived) <= 10.0).all()
    assert np.abs(error_us(made, true)).max() < 10_000
    assert all(b.time_us > a.time_us for a, b in pairwise(made))


# -- with a wrong rate ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("sent", [5.0, 10.0, 15.0, 19.0, 25.0, 40.0])
def test_a_wrong_rate_is_replaced_by_the_measured_rate(sent: float) -> None:
    """No loss is invented, and the times are right after some seconds."""
    true = np.arange(0.0, 30.0, 1.0 / sent)
    clock = DeviceClock(period=1.0 / 20.0)
    made = stamps(clock, np.full(true.size, nan), arrivals(true, 2e-3))
    assert clock.rate == pytest.approx(sent, rel=0.01)
    assert sum(stamp.missing for stamp in made) == clock.invented
    assert np.abs(error_us(made, true)[70:]).max() < 5_000
    assert np.abs(error_us(made, true)).max() < 0.11e6
    assert not any(stamp.missing for stamp in made[17:])


@pytest.mark.parametrize("burst", [1, 3, 8])
@pytest.mark.parametrize("seed", range(3))
def test_a_line_that_loses_many_readings_is_not_a_slower_instrument(burst: int, seed: int) -> None:
    """Of 20 readings/s, 30 % are lost, alone or in bursts; the losses are counted and the times are right."""
    random = np.random.default_rng(seed)
    numbers: list[int] = []
    while len(numbers) < 3_000:
        lost = random.geometric(1.0 / burst) if random.random() < 0.43 / burst else 0
        numbers.append((numbers[-1] if numbers else -1) + 1 + lost)
    true: FloatArray = 0.05 * np.array(numbers)
    clock = DeviceClock(period=0.05)
    made = stamps(clock, np.full(true.size, nan), arrivals(true, 1e-3, seed))
    assert clock.rate == pytest.approx(20.0)
    assert sum(stamp.missing for stamp in made) == pytest.approx(numbers[-1] - len(numbers) + 1, abs=5)
    assert error_us(made, true).std() < 10_000


def test_a_backlog_is_not_a_faster_instrument() -> None:
    """100 readings of 20 Hz arrive in 1 s after a pause of the link, one by one."""
    true = np.arange(0.0, 60.0, 0.05)
    arrived = arrivals(true, 2e-3)
    late = (true > 30.0) & (true < 35.0)
    arrived[late] = 35.0 + np.arange(late.sum()) * 0.01
    clock = DeviceClock(period=0.05)
    stamps(clock, np.full(true.size, nan), np.maximum.accumulate(arrived))
    assert clock.rate == pytest.approx(20.0)


def test_a_wrong_rate_of_an_instrument_with_a_clock_invents_no_losses() -> None:
    true = np.arange(0.0, 60.0, 0.1)
    clock = DeviceClock(period=0.05)
    made = stamps(clock, true, arrivals(true, 2e-3))
    assert clock.rate == pytest.approx(10.0)
    assert sum(stamp.missing for stamp in made) == clock.invented
    assert not any(stamp.missing for stamp in made[17:])
