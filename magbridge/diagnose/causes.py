"""The causes: one small function each, with its physics, equation and source, and one row in a table.

Each takes the problem and returns candidates over a grid of its nonlinear parameters. Widths are plausible sizes
(1-sigma of a Gaussian prior): they set Occam's factor, not what can be found.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import product
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.followers import ClockEffect, MonomialEffect, PlayEffect, PowersEffect
from magbridge.calibration.instrument import RateEffect, ResponseEffect, TimeEffect
from magbridge.calibration.terms import full_order
from magbridge.diagnose.candidates import AXES, Candidate, of_effect, of_reference
from magbridge.diagnose.problem import Problem, history

__all__ = ["CAUSES", "Cause"]

FloatArray = NDArray[np.float64]

LAGS = (0.0, 900.0, 3600.0, 12000.0, 40000.0)
ONSETS = 40


class Cause(NamedTuple):
    """A row of the table.

    Attributes
    ----------
    candidates : callable
        ``Problem -> list of Candidate``.
    needs : str
        What a log must have for it to be tested at all.
    separated_by : str
        The manoeuvre that tells it from what it hides behind.
    """

    candidates: Callable[[Problem], list[Candidate]]
    needs: str
    separated_by: str


def _channels(problem: Problem, kind: str) -> list[str]:
    own = {parameter.name for parameter in problem.calibration.parameters}
    return [name for name, c in problem.survey.channels.items() if kind in c.kinds and name not in own]


def _range(problem: Problem, name: str) -> tuple[float, float]:
    values = problem.survey.channels[name].values
    return float(values.min()), float(values.max())


def _origins(problem: Problem, name: str) -> list[float]:
    """Where the channel may have stood when the vehicle was calibrated."""
    low, high = _range(problem, name)
    middle = float(np.mean(problem.survey.channels[name].values))
    if problem.survey.learned.any():  # then the data hold the calibration's own values of it
        return [middle]
    return [middle, 2 * low - high, 2 * high - low]


def _thermal(problem: Problem, on: Literal["offset", "scale"]) -> list[Candidate]:
    found = []
    field, longest = problem.calibration.reference.field, 2.0 * float(np.ptp(problem.survey.time))
    unit = "nT/degC" if on == "offset" else f"nT/degC at {field:.0f} nT"
    for name in _channels(problem, "temperature"):

        @cache
        def lagged(lag: float, name: str = name) -> FloatArray:
            effect = ChannelEffect(cause="", channel=name, lag=lag)
            return history(problem.survey, problem.calibration, effect)

        def again(origin: float, lag: float, name: str = name, lagged: Any = lagged) -> Candidate:
            lag = max(lag, 0.0)
            effect = ChannelEffect(cause=f"temperature_{on}", channel=name, origin=origin, lag=lag, on=on)
            shape = {"origin": (origin, "degC"), "lag": (lag, "s")}
            phi = lagged(lag)
            return of_effect(
                problem,
                effect,
                5.0,
                unit,
                channel=name,
                shape=shape,
                again=again,
                phi=lambda rows: phi[:, rows] - origin,
            )

        lags = [lag for lag in LAGS if lag <= longest]
        found += [again(origin, lag) for origin in _origins(problem, name) for lag in lags]
    return found


def temperature_offset(problem: Problem) -> list[Candidate]:
    """Core and electronics have an offset that follows temperature: ``T += b (theta_lag - theta_0)``.

    ``dtheta_lag/dt = (theta - theta_lag) / lag``. Typically 0.1 nT/degC for a good fluxgate, several for a low-power
    one (Primdahl 1979, J. Phys. E 12:241). Separated from depth by the thermal hysteresis of dive and climb.
    """
    return _thermal(problem, "offset")


def temperature_scale(problem: Problem) -> list[Candidate]:
    """Coil constant and resistances follow temperature: ``A += diag(b) (theta_lag - theta_0)``, 10-100 ppm/degC."""
    return _thermal(problem, "scale")


def offset_step(problem: Problem) -> list[Candidate]:
    """The offset jumps: a power cycle settles it anew, a shock or a magnet remagnetises: ``T += b H(t - t_0)``."""
    survey = problem.survey
    t = survey.time
    fresh = t[~survey.learned]
    onsets = np.quantile(fresh, np.linspace(0.02, 0.98, ONSETS)) if fresh.size else t[:0]

    def again(onset: float) -> Candidate:
        effect = TimeEffect(cause="offset_step", shape="step", start=onset)
        phi = lambda rows: (t[rows] >= onset)[None].astype(float)  # noqa: E731  (a regressor is one line)
        return of_effect(problem, effect, 100.0, "nT", shape={"onset": (onset, "s")}, again=again, phi=phi)

    return [again(float(onset)) for onset in np.unique([fresh.min() - 1.0, *onsets, *survey.cycles])]


def offset_drift(problem: Problem) -> list[Candidate]:
    """The offset creeps with ageing and relaxing stress: ``T += b_1 x + b_2 x^2``, ``x = (t - t_0) / duration``."""
    t = problem.survey.time
    span = float(t[-1] - t[0])
    made = []
    for order, start in ((1, t[0]), (1, 0.5 * (t[0] + t[-1])), (2, t[0])):
        effect = TimeEffect(cause="offset_drift", shape="drift", start=float(start), period=span, order=order)

        def phi(rows: slice, order: int = order, start: float = float(start)) -> FloatArray:
            return np.stack([((t[rows] - start) / span) ** (k + 1) for k in range(order)])

        made.append(of_effect(problem, effect, 50.0, f"nT in {span / 3600:.3g} h", phi=phi))
    return made


def current_field(problem: Problem) -> list[Candidate]:
    """A current loop is a fixed source: ``T += b I(t)`` (Biot and Savart), zero when the current is."""
    made = []
    for name in _channels(problem, "current"):
        low, high = _range(problem, name)
        effect = ChannelEffect(cause="current_field", channel=name)
        unit = f"nT/{problem.survey.channels[name].unit or '1'}"
        made.append(of_effect(problem, effect, 100.0 / max(abs(low), abs(high)), unit, channel=name))
    return made


def pressure_offset(problem: Problem) -> list[Candidate]:
    """Pressure strains the hull and its magnetisation follows (Villari effect), and the sensor's mount: ``T += b p``."""
    made = []
    for name in _channels(problem, "pressure"):
        low, high = _range(problem, name)
        effect = ChannelEffect(cause="pressure_offset", channel=name)
        unit = f"nT/{problem.survey.channels[name].unit or '1'}"
        made.append(of_effect(problem, effect, 50.0 / max(abs(low), abs(high)), unit, channel=name))
    return made


def unmodelled_actuator(problem: Problem) -> list[Candidate]:
    """Something else that moves carries iron: ``T += G(r(p)) m``, to third order in p (see :mod:`~.calibration.dipole`)."""
    made = []
    for name in _channels(problem, "position"):
        low, high = _range(problem, name)
        scale = 0.5 * (high - low)
        centres = [0.5 * (low + high)] if problem.survey.learned.any() else [0.5 * (low + high), low, high]
        for order, centre in product((1, 2, 3), centres):
            effect = PowersEffect(
                cause="unmodelled_actuator", channel=name, centre=centre, scale=scale, order=order
            )
            width = np.repeat(100.0 * 0.3 ** np.arange(order), 3)
            made.append(
                of_effect(
                    problem,
                    effect,
                    width,
                    f"nT per {scale:.3g} {problem.survey.channels[name].unit}",
                    channel=name,
                )
            )
    return made


def actuator_order(problem: Problem) -> list[Candidate]:
    """A modelled mass needs a power or a cross term that its polynomial lacks: ``T += b prod x_k^e_k`` (paper, eq. 8)."""
    calibration = problem.calibration
    k = len(calibration.parameters)
    if not k:
        return []
    present = {e for term in calibration.terms for e in term.expand(calibration).exponents}
    highest = max(sum(e) for e in present)
    made = []
    for exponents in full_order(k, min(highest + 1, 5)):
        if exponents not in present:
            effect = MonomialEffect(cause="actuator_order", exponents=exponents)
            label = " ".join(
                f"{p.name}^{e}" if e > 1 else p.name
                for p, e in zip(calibration.parameters, exponents, strict=True)
                if e
            )
            made.append(of_effect(problem, effect, 50.0, f"nT for {label}", channel=label))
    return made


def hysteresis(problem: Problem) -> list[Candidate]:
    """Backlash of the drive, or steel remagnetised by its own motion: ``T += b (y - p) / width``, y the play of p."""
    made = []
    # only of masses that are modelled: a wide play of another is that other itself
    for name in (parameter.name for parameter in problem.calibration.parameters):
        low, high = _range(problem, name)

        def again(width: float, name: str = name) -> Candidate:
            effect = PlayEffect(cause="hysteresis", channel=name, width=width)
            unit = problem.survey.channels[name].unit
            return of_effect(
                problem, effect, 50.0, "nT", channel=name, shape={"width": (width, unit)}, again=again
            )

        made += [again(share * (high - low)) for share in (0.05, 0.15, 0.3, 0.5)]
    return made


def _rates(problem: Problem) -> FloatArray:
    """(3, n) dH_r/dt, nT/s, by differences both ways.

    A one-sided difference holds the sample's own noise, which would pass for an effect; a two-sided one is odd in
    time, so that against stationary noise its inner product vanishes on average.
    """
    survey = problem.survey
    H, t = survey.field, survey.time
    out = np.zeros((3, len(t)))
    both = np.flatnonzero(survey.follows[1:-1] & survey.follows[2:]) + 1
    out[:, both] = ((H[both + 1] - H[both - 1]) / (t[both + 1] - t[both - 1])[:, None]).T
    return out


def eddy_current(problem: Problem) -> list[Candidate]:
    """A turning conductor carries currents: ``T_i += k_ij dH_j/dt``, i != j (Tolles & Lawson 1950)."""
    names = tuple(i + j for i in AXES for j in AXES if i != j)
    effect = RateEffect(cause="eddy_current", on="eddy")
    return [of_effect(problem, effect, 0.3, "s", names=names, phi=_rates(problem))]


def channel_skew(problem: Problem) -> list[Candidate]:
    """One digitiser takes the channels in turn: ``T_i += tau_i dH_i/dt`` (paper, section 3)."""
    effect = RateEffect(cause="channel_skew", on="skew")
    return [of_effect(problem, effect, 0.5, "s", phi=_rates(problem))]


def filter_lag(problem: Problem) -> list[Candidate]:
    """The anti-alias filter holds the field back against the telemetry: ``T += -tau dH/dt`` (paper, section 3).

    In a uniform field on a vehicle without moving iron it is invisible: ``|H|`` does not change.
    """
    effect = RateEffect(cause="filter_lag", on="lag")
    return [of_effect(problem, effect, 2.0, "s", names=("delay",), phi=_rates(problem))]


def clock_offset(problem: Problem) -> list[Candidate]:
    """Telemetry stamped by another clock: ``theta += tau dtheta/dp dp/dt``."""
    survey, calibration = problem.survey, problem.calibration
    if not calibration.parameters:
        return []
    kernel = calibration.kernel
    W = kernel.weights[: kernel.monomials] * np.array([calibration.reference.field] * 6 + [1.0] * 3)
    positions = survey.values([parameter.name for parameter in calibration.parameters])
    theta = W.T @ kernel.monomials_of(positions)
    rates, t = np.zeros_like(theta), survey.time
    both = np.flatnonzero(survey.follows[1:-1] & survey.follows[2:]) + 1
    rates[:, both] = (theta[:, both + 1] - theta[:, both - 1]) / (t[both + 1] - t[both - 1])
    return [of_effect(problem, ClockEffect(), 5.0, "s", names=("delay",), phi=rates)]


def nonlinearity(problem: Problem) -> list[Candidate]:
    """The response bends: ``T_i += b_i (H_i / H_0)^p``, p = 2 (an even harmonic's leak) or 3 (a saturating core)."""
    unit, H = problem.calibration.reference.field, problem.survey.field
    made = []
    for power in (2, 3):
        effect = ResponseEffect(cause="nonlinearity", unit=unit, power=power)
        phi = lambda rows, power=power: (H[rows].T / unit) ** power  # noqa: E731
        made.append(
            of_effect(problem, effect, 50.0, f"nT at {unit:.0f} nT", phi=phi, shape={"power": (power, "1")})
        )
    return made


def saturation(problem: Problem) -> list[Candidate]:
    """A channel compresses or clips near its end: ``T_i -= b_1 + b_2 (H_i - knee) / H_0`` beyond the knee."""
    unit, H = problem.calibration.reference.field, problem.survey.field
    made = []
    for axis, sign in product(range(3), (1.0, -1.0)):
        reading = sign * H[:, axis]
        if reading.max() < 0.2 * unit:  # nowhere near any end
            continue
        for share in (0.7, 0.85, 0.95, 0.99):
            knee = sign * float(np.quantile(reading, share))

            def again(knee: float, axis: int = axis) -> Candidate:
                effect = ResponseEffect(cause="saturation", unit=unit, axis=axis, knee=knee)
                way = 1.0 if knee >= 0.0 else -1.0

                def phi(rows: slice) -> FloatArray:
                    over = way * (H[rows, axis] - knee)
                    return np.stack([way * (over >= 0), way * np.maximum(over, 0.0) / unit])

                names = (f"{AXES[axis]} beyond", f"{AXES[axis]} slope")
                return of_effect(
                    problem, effect, np.array([100.0, 0.1 * unit]), "nT", names=names, phi=phi,
                    shape={"knee": (knee, "nT")}, again=again,
                )  # fmt: skip

            made.append(again(knee))
    return made


def diurnal_variation(problem: Problem) -> list[Candidate]:
    """The Earth's field itself varies: the Sq system's harmonics of the day, along the field (Chulliat et al. 2016)."""
    t = problem.survey.time
    span = float(t[-1] - t[0])
    harmonics = [h for h in (1, 2, 3) if 86400.0 / h < 4.0 * span]
    made = []
    for some in (harmonics[k:] for k in range(len(harmonics))):

        def basis(rows: slice, some: list[int] = some) -> FloatArray:
            angle = 2.0 * np.pi * t[rows, None] / 86400.0 * np.array(some)
            return np.hstack([np.cos(angle), np.sin(angle)])

        names = tuple(f"{f} {24 // h} h" for f in ("cos", "sin") for h in some)
        width = np.tile(20.0 / np.array(some), 2)
        made.append(of_reference(problem, "diurnal_variation", basis, width, names))
    return made


def map_error(problem: Problem) -> list[Candidate]:
    """The anomaly map is wrong: smooth in place, the same on every pass; cosines over the box that was visited."""
    place = problem.survey.place
    if place is None:
        return []
    low, size = place.min(axis=0), np.ptp(place, axis=0)
    if size.max() < 200.0:
        return []
    u = (place - low) / max(float(size.max()), 1.0)
    made = []
    for highest in (1, 2, 3):
        waves = [(i, j) for i in range(highest + 1) for j in range(highest + 1) if i + j > 0]

        def basis(rows: slice, waves: list[tuple[int, int]] = waves) -> FloatArray:
            return np.stack(
                [np.cos(np.pi * i * u[rows, 0]) * np.cos(np.pi * j * u[rows, 1]) for i, j in waves], axis=1
            )

        width = np.array([40.0 / (i + j) for i, j in waves])
        names = tuple(f"north {i} east {j}" for i, j in waves)
        made.append(of_reference(problem, "map_error", basis, width, names))
    return made


def reference_bias(problem: Problem) -> list[Candidate]:
    """The reference is off by a constant: the main-field model at this site, some tens of nT."""
    ones = (~problem.survey.learned[:, None]).astype(np.float64)
    return [of_reference(problem, "reference_bias", lambda rows: ones[rows], np.array([30.0]), ("bias",))]


def interference_tone(problem: Problem) -> list[Candidate]:
    """Machinery at a fixed frequency, seen through the sampling: ``T += b cos + c sin (2 pi t / period)``.

    Frequencies are those where the differenced residual, seen through each channel's projection, has its highest peaks.
    """
    survey = problem.survey
    t = survey.time
    interval = float(np.median(np.diff(t)))
    slots = np.rint((t - t[0]) / interval).astype(np.int64)
    if slots[-1] > 8 * len(t):
        return []
    flat = np.append(0.0, np.diff(problem.residual) * survey.follows[1:])
    size = 1 << int(np.ceil(np.log2(slots[-1] + 1)) + 1)
    power = np.zeros(size // 2 + 1)
    for axis in range(3):
        series = np.bincount(slots, flat * problem.slopes[:, 6 + axis], minlength=size)
        power += np.abs(np.fft.rfft(series)) ** 2
    frequency = np.fft.rfftfreq(size, interval)
    smooth = np.convolve(power, np.ones(201) / 201, mode="same") + 1e-300
    ratio = np.where(frequency * float(np.ptp(t)) > 20.0, power / smooth, 0.0)
    made: list[Candidate] = []

    def again(period: float) -> Candidate:
        effect = TimeEffect(cause="interference_tone", shape="tone", start=float(t[0]), period=period)

        def phi(rows: slice) -> FloatArray:
            angle = 2.0 * np.pi * (t[rows] - t[0]) / period
            return np.stack([np.cos(angle), np.sin(angle)])

        names = tuple(f"{f} {axis}" for f in ("cos", "sin") for axis in AXES)
        return of_effect(
            problem, effect, 10.0, "nT", names=names, phi=phi, shape={"period": (period, "s")}, again=again,
            trials=0.5 * len(t),
        )  # fmt: skip

    for _ in range(5):
        peak = int(np.argmax(ratio))
        if ratio[peak] <= 0.0:
            break
        made.append(again(1.0 / frequency[peak]))
        ratio[max(peak - 4, 0) : peak + 5] = 0.0
    return made


CAUSES: dict[str, Cause] = {
    "temperature_offset": Cause(temperature_offset, "a temperature that varies", "dive and climb through one depth with a thermal lag between; or hold one depth for an hour after launch"),
    "temperature_scale": Cause(temperature_scale, "a temperature that varies", "roll about the field at two temperatures: a scale follows the channel's reading, an offset does not"),
    "offset_step": Cause(offset_step, "time", "log the power-cycle counter; fly one attitude before and after"),
    "offset_drift": Cause(offset_drift, "time", "return to one place and attitude hours later"),
    "current_field": Cause(current_field, "a current", "run the motor with its mass held, and hold the motor with its mass moved"),
    "unmodelled_actuator": Cause(unmodelled_actuator, "the position of something that moves", "move it at one attitude"),
    "actuator_order": Cause(actuator_order, "a calibration with parameters", "move one mass in small steps over its whole range at one attitude"),
    "hysteresis": Cause(hysteresis, "a calibration with parameters", "approach one position from both sides"),
    "eddy_current": Cause(eddy_current, "turns", "reverse the turn"),
    "channel_skew": Cause(channel_skew, "turns", "reverse the turn; roll about the axis that all channels share"),
    "filter_lag": Cause(filter_lag, "masses that move while sampled", "the filter's corner is known: switch it, or move an actuator by a step"),
    "clock_offset": Cause(clock_offset, "a calibration with parameters, which move while sampled", "move an actuator at constant attitude"),
    "nonlinearity": Cause(nonlinearity, "attitudes that take a channel over its range", "turn every channel through the whole field"),
    "saturation": Cause(saturation, "a channel near its end", "turn the channel away from the field: only near full scale does it stay"),
    "pressure_offset": Cause(pressure_offset, "depth or pressure that varies", "hold one depth for an hour: temperature settles, pressure stays"),
    "diurnal_variation": Cause(diurnal_variation, "at least six hours", "a base station ashore"),
    "map_error": Cause(map_error, "positions over some hundred metres", "cross the track: a map's error is the same on every pass"),
    "reference_bias": Cause(reference_bias, "a reference", "calibrate and survey at one place; a proton magnetometer beside"),
    "interference_tone": Cause(interference_tone, "even sampling", "change the sampling rate: an alias moves"),
}  # fmt: skip
