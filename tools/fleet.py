"""Measure the survey's error after two calibration runs, with a fleet's prior and without.

Each vehicle of a simulated fleet is random and performs several deployments: ten runs, then a survey on
another day. A refit (overhaul) changes the fixed iron and the places and moments of the masses; with `--refit
battery` it also replaces the battery pack by one with a random moment. A power-up changes the sensor's
offsets. The fleet's prior is fitted to all deployments except the last of each vehicle. The last deployment
is calibrated with some of its runs, with and without the prior, and scored on its survey as in
tools/accuracy.py. The bound assumes that the vehicle before its last refit and the standard deviations of
all changes are known exactly.

    python tools/fleet.py --vehicles 12 --deployments 8 --runs 0 2 10
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import msgspec
import numpy as np
from studies import Row, Study, in_order, show
from study_worlds import MASSES, SCORES, Glider, best_fit, glider

from magbridge import Calibration, fit, observations
from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.pose import Known, Mounting
from magbridge.calibration.model import Noise, Reference
from magbridge.calibration.terms import Polynomial
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms
from magbridge.fleet.hierarchy import FLEET_LEVELS
from magbridge.fleet.learn import Lesson, learn_fleet
from sitl import load
from sitl.platform import MOMENT, MOUNTINGS, Matrix, Vehicle, draw_vehicle

REFITTED = {"fixed iron": 50.0, "soft iron": 1e-3, "place": 0.005, "moment": 0.1}
"""1-sigma of a refit's changes, per axis: fixed iron, nT; soft iron, nT/nT; place, m; moment, A m²."""
POWERED_UP = 5.0
"""1-sigma of the change of an axis' offset from one power-up to the next, nT."""
OFFSET = 1_000_000
"""Distance between the seeds of vehicles and the seeds of their deployments."""


class Flight(NamedTuple):
    """Deployment `number` of a vehicle, with the kind of refit and the deployments from refit to refit."""

    vehicle: int
    number: int
    refit: str
    every: int
    seed: int

    def state(self) -> Vehicle:
        """Return the vehicle as it is in this deployment."""
        known = draw_vehicle(np.random.default_rng([self.seed, self.vehicle]), MASSES)
        rng = np.random.default_rng([self.seed, self.vehicle, 1 + self.number // self.every])
        fresh = draw_vehicle(rng, MASSES)
        mass = {}
        for name, one in known.mass.items():
            new = self.refit == "battery" and name == "battpos"
            moment = fresh.mass[name].moment if new else tuple(rng.normal(one.moment, REFITTED["moment"]))
            at = tuple(rng.normal(one.at, REFITTED["place"]))
            mass[name] = msgspec.structs.replace(one, at=at, moment=moment)
        iron = rng.normal(known.hard_iron, REFITTED["fixed iron"])
        soft = rng.normal(known.soft_iron, REFITTED["soft iron"])
        up = np.random.default_rng([self.seed, self.vehicle, OFFSET + self.number])
        hard, matrix = tuple(up.normal(iron, POWERED_UP)), msgspec.convert(soft.tolist(), Matrix)
        return Vehicle(hard_iron=hard, soft_iron=matrix, mass=mass)

    def fly(self) -> Glider:
        """Return the vehicle with its calibration runs and its survey."""
        scenario = load("random_glider").replace(vehicle=self.state(), masses=MASSES)
        return glider(scenario, OFFSET * (1 + self.seed) + 1000 * self.vehicle + self.number)

    def widths(self) -> FloatArray:
        """Return the 1-sigma (k,) of the vehicle's changes since its last state, by a refit or a power-up."""
        refitted = self.number % self.every == 0
        nothing = 1e-9  # the bound divides by it
        widths = [*[REFITTED["soft iron"] if refitted else nothing] * 9]
        widths += [np.hypot(REFITTED["fixed iron"] * refitted, POWERED_UP)] * 3
        for name in MASSES:
            new = self.refit == "battery" and name == "battpos"
            moment = np.sqrt(2.0) * MOMENT if new else REFITTED["moment"]
            widths += [moment if refitted else nothing] * 3 + [nothing] * 3
            widths += [REFITTED["place"] if refitted else nothing] * 3
        return np.array(widths)


def lesson(flight: Flight) -> Lesson | str:
    """Return the fit of a deployment as input of the fleet's prior, or the reason of its failure."""
    runs = flight.fly().runs
    try:
        found = fit(observations(runs, MASSES))
    except CalibrationError as error:
        return str(error)
    calibration, term = found.calibration, found.calibration.terms[0]
    if found.information is None:
        return f"{calibration.method}: has nothing to teach"
    return Lesson(
        f"vehicle {flight.vehicle}", f"refit {flight.number // flight.every}", str(flight.number),
        float(runs["time"][0]), calibration.parameters, term.exponents, calibration.reference.field,
        calibration.noise.sensor, found.information,
    )  # fmt: skip


def run(flight: Flight, counts: tuple[int, ...], known: Known) -> Iterator[Row]:
    """Calibrate a vehicle's last deployment with some of its runs, each with and without the prior."""
    flown = flight.fly()
    label = flown.runs["run"].to_numpy()
    for count in counts:
        part = flown.runs.isel(time=np.isin(label, np.unique(label)[:count]))
        for name, prior in {"none": None, "fleet": known}.items():
            if not count and prior is None:
                continue
            row: Row = {"runs": count, "prior": name, "vehicle": flight.vehicle}
            try:
                found = fit(observations(part, MASSES), known=prior).calibration if count else expected(known)
                yield row | flown.score(found)
            except CalibrationError as error:
                yield row | {"failed": str(error)}
        if count:
            best = best_fit(flown.vehicle, part, flown.survey, 1.0, widths=flight.widths())
            ratio = rms(best.bound) / rms(best.floor)
            yield {"runs": count, "prior": "bound", "vehicle": flight.vehicle, "ratio": ratio}


def expected(known: Known) -> Calibration:
    """Return the fleet's prior as a calibration that has used no run."""
    return Calibration(
        known.parameters, (Polynomial(exponents=known.exponents),), known.mean, known.covariance,
        Noise(1.0), Reference(known.field),
    )  # fmt: skip


def cases_of(options: argparse.Namespace) -> list[tuple[Flight, tuple[int, ...], Known]]:
    """Learn the fleet's prior, print its widths, and return the cases: each vehicle's last deployment."""
    flights = [
        Flight(vehicle, number, options.refit, options.refit_interval, options.seed)
        for vehicle, number in product(range(options.vehicles), range(options.deployments))
    ]
    last = options.deployments - 1
    reported = in_order(lesson, [(one,) for one in flights if one.number < last], options)
    where = {name: Mounting(MOUNTINGS[name].at, MOUNTINGS[name].travel) for name in MASSES}
    mounted = {f"vehicle {k}": where for k in range(options.vehicles)} if options.mounted else {}
    fleet = learn_fleet([one for one in reported if isinstance(one, Lesson)], mounted)
    for error in (one for one in reported if isinstance(one, str)):
        show(f"not learned from: {error}")
    widths = zip(FLEET_LEVELS, np.sqrt(np.median(fleet.population.variances.own, axis=1)), strict=True)
    learned = ", ".join(f"{name} {width:.2g}" for name, width in widths)
    show(f"learned: median of the physical widths: {learned}")
    refit = f"refit {last // options.refit_interval}"
    runs, latest = tuple(options.runs), [one for one in flights if one.number == last]
    return [(one, runs, fleet.known(f"vehicle {one.vehicle}", refit)) for one in latest]


STUDY = Study(run, ("runs", "prior"), SCORES)


if __name__ == "__main__":
    STUDY.main(
        __doc__, cases_of, vehicles=12, deployments=8, refit_interval=2, refit=("usual", "battery"),
        runs=[0, 2, 10], mounted=False, seed=0,
    )  # fmt: skip
