"""Test that an encoder is the inverse of its driver, to the resolution of the instrument."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instruments import CASES, instrument

from magbridge.errors import ConfigError
from magbridge.records import Reading
from magbridge.sensors import DRIVERS, Driver, open_driver
from sitl.fluxgate import ENCODERS, Encoder, open_encoder
from sitl.instrument import Instrument, Samples, rotation
from sitl.signals import autoregressive

GAUSS = 100_000.0
QUANTUM_NT = {
    "digitizer": 2.5 / 2**23 / 5e-5 / 2,
    "digitizer, gain 4": 2.5 / 4 / 2**23 / 2e-5 / 2,
    "hmr2300 binary": GAUSS / 15_000 / 2,
    "hmr2300 ascii": GAUSS / 15_000 / 2,
    "rm3100": open_driver("rm3100", {"cycle_count": 400}).nt_per_count / 2,
    "twinleaf 2": 0.004,  # float32
    "twinleaf 2 behind a hub, µT": 0.004,
    "twinleaf 1": 0.004,
    "ascii counts": 0.25,
}
"""Largest error of quantisation, nT; a line of text has none."""
HAS_TIME = ("digitizer", "rm3100", "twinleaf", "ascii nmea", "ascii keys")
HAS_TEMPERATURE = ("digitizer", "twinleaf 2", "twinleaf 1", "ascii nmea", "ascii range")
RANGE_NT = {"hmr2300": 200_000.0, "twinleaf": 100_000.0, "digitizer": 31_000.0, "rm3100": 800_000.0}


def through(driver: Driver, encoder: Encoder, sent: list[Reading]) -> list[Reading]:
    return driver.feed(b"".join(encoder.encode(reading) for reading in sent))


def test_every_driver_has_its_instrument() -> None:
    assert list(ENCODERS) == list(DRIVERS)


@pytest.mark.parametrize("case", CASES)
@given(data=st.data())
@settings(max_examples=30)
def test_round_trip(case: str, data: st.DataObject) -> None:
    name, options = CASES[case]
    limit = 0.99 * options.get("range", RANGE_NT.get(name, 1e6))
    fields = data.draw(st.lists(st.tuples(*[st.floats(-limit, limit)] * 3), min_size=8, max_size=8))
    sent = [
        Reading(field, device_time=0.05 * k, temperature=4.0 + k, supply=3.3)
        for k, field in enumerate(fields)
    ]
    driver, encoder = instrument(case, 20.0)
    got = through(driver, encoder, sent)
    assert len(got) == len(sent)
    for there, here in zip(sent, got, strict=True):
        assert here.field == pytest.approx(there.field, abs=QUANTUM_NT.get(case, 0.0) * 1.001 + 1e-6, rel=0)
        assert not here.saturated
        if case.startswith(HAS_TIME):
            assert here.device_time == pytest.approx(there.device_time, abs=1e-6)
        if case in HAS_TEMPERATURE:
            assert here.temperature == pytest.approx(there.temperature, abs=0.005)
    if got[0].sequence is not None:
        assert [reading.sequence for reading in got] == list(range(8))
    assert driver.frames_bad == 0


@pytest.mark.parametrize("case", ["digitizer", "hmr2300 binary", "hmr2300 ascii", "twinleaf 2"])
def test_a_field_beyond_the_range_saturates(case: str) -> None:
    driver, encoder = instrument(case, 20.0)
    fields = [(1000.0 + k, 2000.0, -300_000.0 if k == 7 else 100.0) for k in range(12)]
    got = through(driver, encoder, [Reading(field, device_time=0.05 * k) for k, field in enumerate(fields)])
    assert [k for k, reading in enumerate(got) if reading.saturated] == [7]
    assert got[7].field[2] == pytest.approx(-driver.range_nt, rel=1e-5)


@pytest.mark.parametrize("case", ["digitizer", "twinleaf 2", "twinleaf 1", "ascii nmea"])
def test_a_power_cycle_shows(case: str) -> None:
    driver, encoder = instrument(case, 20.0)
    one = Reading((1.0, 2.0, 3.0), device_time=0.0)
    (before,) = through(driver, encoder, [one])
    encoder.power_on()
    (after,) = through(driver, encoder, [one])
    assert None not in (before.power_cycle, after.power_cycle)
    assert after.power_cycle != before.power_cycle
    assert after.sequence == 0


def test_hmr2300_obeys_only_when_asked_properly() -> None:
    encoder = open_encoder("hmr2300", {})
    one = Reading((GAUSS / 2, 0.0, -GAUSS), device_time=0.0)
    assert not encoder.streaming
    assert encoder.encode(one) == b""
    assert encoder.feed(b"*99P\r") == b"  7,500        0  -15,000  \r"
    assert encoder.feed(b"*99B\r") == b"WE_OFF\r"
    assert encoder.feed(b"*99W") + encoder.feed(b"E\r*99b\r") == b"OK\rBINARY ON\r"
    assert encoder.feed(b"hello\r*99QQ\r") == b"Re-enter\rRe-enter\r"
    assert encoder.feed(b"*99WE\r*99R=100\r*99C\r") == b"OK\rOK\r"
    assert encoder.encode(one) == bytes.fromhex("1D4C 0000 C568 0D")
    assert encoder.feed(b"\x1b") == b""
    assert encoder.encode(one) == b""


def test_twinleaf_says_no_to_other_requests() -> None:
    encoder, other = open_encoder("twinleaf", {}), open_encoder("twinleaf", {"route": "/3"})
    (start,) = open_driver("twinleaf", {}).start()
    assert other.feed(start + b"garbage\xc0\xc0") == b""
    answers = encoder.feed(start)
    assert b"\x04\x00\x04\x00\x01\x00\x02\x00" in answers  # RPC error, request 1 (data.send_all): not found
    assert b"vector.x" in answers


def test_wrong_options_name_the_key() -> None:
    with pytest.raises(
        ConfigError, match=r"my.toml: sensor.driver: can emulate ascii, digitizer, hmr2300, rm3100, twinleaf"
    ):
        open_encoder("compass", {}, source="my.toml")
    with pytest.raises(ConfigError, match=r"bridge.toml: sensor.options.sensitivity: missing key"):
        open_encoder("digitizer", {})


@given(st.lists(st.binary(max_size=50), max_size=10), st.sampled_from(sorted(CASES)))
@settings(max_examples=100)
def test_an_instrument_survives_any_commands(chunks: list[bytes], case: str) -> None:
    _, encoder = instrument(case, 20.0)
    for chunk in chunks:
        encoder.feed(chunk)


# ---- The instrument ----------------------------------------------------------------------------------------


FIELD = np.array([17000.0, -6000.0, 49600.0])
IDEAL = Instrument(noise_sigma=0.0, corner=0.0)


def measure(
    instrument: Instrument, field: np.ndarray, water: np.ndarray, when: np.ndarray, seed: int = 0
) -> Samples:
    return instrument.measure(field, water, 0.5, when, np.random.default_rng(seed))


def constant(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.tile(FIELD, (n, 1)), np.full(n, 2.0), np.arange(0.0, (n - 2) * 0.5, 4.0)


def test_an_ideal_instrument_reads_the_field_to_half_a_step_of_its_converter() -> None:
    samples = measure(IDEAL, *constant(100))
    assert np.abs(samples.channels - FIELD).max() <= 100_000 / 2**23 / 2


def test_the_converter_rounds_to_its_steps_and_clips_at_its_ends() -> None:
    coarse = Instrument(bits=8, full_scale=128.0)
    given = np.array([0.4, 0.6, -0.6, 126.9, 500.0, -500.0])
    np.testing.assert_array_equal(coarse.digitise(given), [0, 1, -1, 127, 127, -128])


def test_the_axes_stand_at_the_angles_given() -> None:
    m = Instrument(orthogonality=(0.5, -0.3, 0.2), scale=(1.01, 0.99, 1.0)).matrix()
    unit = m / np.linalg.norm(m, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(m, axis=1), [1.01, 0.99, 1.0])
    for (i, j), deg in {(0, 1): 0.5, (0, 2): -0.3}.items():
        assert 90 - np.degrees(np.arccos(unit[i] @ unit[j])) == pytest.approx(deg, abs=1e-6)
    assert 90 - np.degrees(np.arccos(unit[1] @ unit[2])) == pytest.approx(0.2, abs=0.01)


def test_a_turned_sensor_reads_the_turned_field() -> None:
    turned = Instrument(noise_sigma=0.0, corner=0.0, mounting=(3.0, -2.0, 5.0))
    expected = rotation(3.0, -2.0, 5.0).apply(FIELD, inverse=True)
    np.testing.assert_allclose(measure(turned, *constant(50)).channels[0], expected, atol=0.01)


def test_a_step_in_the_field_is_seen_through_the_rc_filter() -> None:
    field, water, _ = constant(200)
    field[100:] += [1000.0, 0.0, 0.0]  # a ramp of one grid step, 49.5 to 50 s
    when = np.array([40.0, 50.0, 50.5, 55.0])
    seen = measure(Instrument(noise_sigma=0.0), field, water, when).channels[:, 0] - FIELD[0]
    tau = 1 / (2 * np.pi * 0.33)
    ramp = 1000 * (1 - tau / 0.5 * (1 - np.exp(-0.5 / tau)))
    np.testing.assert_allclose(seen, [0, ramp, 1000 + (ramp - 1000) * np.exp(-0.5 / tau), 1000], atol=0.05)


def test_each_channel_is_sampled_when_it_says() -> None:
    n = 400
    field = np.outer(0.5 * np.arange(n), [10.0, 20.0, 30.0])  # ramps, nT/s
    late = Instrument(noise_sigma=0.0, corner=0.0, channel_delay=(0.0, 0.16, 0.32))
    samples = measure(late, field, np.full(n, 2.0), np.arange(0.0, 190.0, 4.0))
    np.testing.assert_allclose(samples.channels, samples.times * [10.0, 20.0, 30.0], atol=0.01)
    np.testing.assert_allclose(samples.times - samples.times[:, :1], np.tile([0, 0.16, 0.32], (48, 1)))


def test_the_fluxgate_warms_up_with_its_lag_and_takes_its_offset_along() -> None:
    n = 40_000
    cold = Instrument(
        noise_sigma=0.0,
        corner=0.0,
        start_temperature=-10.0,
        thermal_lag=3600.0,
        offset_per_degree=(1.0, 0.0, 2.0),
        scale_per_degree=(0.0, 1e-4, 0.0),
    )
    when = np.arange(0.0, 19_000.0, 100.0)
    samples = measure(cold, np.tile(FIELD, (n, 1)), np.full(n, 2.0), when)
    expected = 2.0 - 12.0 * np.exp(-when / 3600.0)
    np.testing.assert_allclose(samples.temperature, expected, atol=1e-6)
    error = samples.channels - FIELD
    np.testing.assert_allclose(error[:, 0], expected - 2.0, atol=0.01)
    np.testing.assert_allclose(error[:, 1], 1e-4 * FIELD[1] * (expected - 2.0), atol=0.01)
    np.testing.assert_allclose(error[:, 2], 2 * (expected - 2.0), atol=0.01)


def test_every_power_on_changes_the_offset() -> None:
    instrument = Instrument(noise_sigma=0.0, turn_on_sigma=50.0, power_on=(100.0, 150.0))
    samples = measure(instrument, *constant(400))
    assert set(samples.power_cycle) == {0.0, 1.0, 2.0}
    means = [samples.channels[samples.power_cycle == k][2:].mean(axis=0) for k in (0.0, 1.0, 2.0)]
    assert np.abs(np.diff(means, axis=0)).max() > 10
    steady = measure(Instrument(noise_sigma=0.0, power_on=(100.0,)), *constant(400))
    assert np.ptp(steady.channels, axis=0).max() == 0


@pytest.mark.parametrize("memory", [0.0, 3.0, 10.0])
def test_noise_has_the_spread_and_memory_asked_for(memory: float) -> None:
    noise = autoregressive(np.random.default_rng(2), (200_000, 2), 5.0, memory)
    assert np.std(noise) == pytest.approx(5.0, rel=0.02)
    expected = np.exp(-1 / memory) if memory else 0.0
    assert np.corrcoef(noise[:-1, 0], noise[1:, 0])[0, 1] == pytest.approx(expected, abs=0.02)
    assert np.std(autoregressive(np.random.default_rng(3), (2, 100_000), 5.0, memory)[0]) == pytest.approx(
        5.0, rel=0.02
    )
