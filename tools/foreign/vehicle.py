"""What goes wrong with the vehicle and is in no table: loose iron, bad contacts, bent encoders."""

from __future__ import annotations

import numpy as np

from sitl.inject.scene import Generator, Scene, direction
from sitl.instrument import rotation
from sitl.signals import autoregressive, first_order
from sitl.world import MU_0_OVER_4_PI, dipole_field


def loose(scene: Scene, size: float, rng: Generator) -> None:
    """A loose magnet slides to the lower end, and sticks until the hull tilts the other way; size in nT."""
    tip = scene.track.pitch - rng.uniform(-5.0, 5.0)
    stick = rng.uniform(5.0, 12.0)
    last = np.maximum.accumulate(np.where(np.abs(tip) > stick, np.arange(len(tip)), 0))
    slid = first_order(np.sign(tip[last]), scene.track.step, 3.0)
    scene.add(slid, size * direction(rng))


def corrosion(scene: Scene, size: float, rng: Generator) -> None:
    """A galvanic current in the hull, which wanders (paint, fouling) and grows with speed; size in nT."""
    wander = autoregressive(rng, (len(scene.t),), 1.0, 2500.0 / scene.track.step)
    fed = np.sqrt(1.0 + np.abs(np.gradient(scene.track.depth, scene.track.step)))
    scene.add(fed * wander, size * direction(rng))


def cargo(scene: Scene, size: float, rng: Generator) -> None:
    """Iron in a sling, partly magnetised by induction, hangs down in a roll but for friction; size in nT."""
    roll, rubs, held = scene.track.roll, rng.uniform(1.0, 3.0), 0.0
    hung = np.empty_like(roll)
    for k, angle in enumerate(roll):
        held = min(max(held, angle - rubs), angle + rubs)
        hung[k] = held
    hung = first_order(hung, scene.track.step, 4.0)
    arm, place = np.array([0.0, 0.0, 0.3]), np.array([-0.6, 0.0, 0.05]) + 0.1 * rng.normal(size=3)
    turn = rotation(hung, np.zeros_like(hung), np.zeros_like(hung))
    away, rest = -(place + turn.apply(arm, inverse=True)), -(place + arm)
    own = turn.apply(direction(rng), inverse=True) + 0.5 * scene.field / np.linalg.norm(scene.field[0])
    moved = dipole_field(away, own) - dipole_field(np.broadcast_to(rest, own.shape), own)
    scene.field = scene.field + size * moved / np.linalg.norm(moved, axis=1).max()


def contact(scene: Scene, size: float, rng: Generator) -> None:
    """A corroded joint that pressure closes carries a varying part of a motor's current; size in nT/A."""
    name = str(rng.choice(["amps_a", "amps_b"]))
    closes = rng.uniform(0.25, 0.6) * scene.track.depth.max()
    shut, part, leads = False, 0.0, np.empty(len(scene.t))
    for k, depth in enumerate(scene.track.depth):
        if shut != (depth > closes + (-8.0 if shut else 8.0)):
            shut, part = not shut, float(rng.lognormal(0.0, 0.4))
        leads[k] = part * shut
    scene.add(leads * scene.logged[name][0], size * direction(rng))


def rotor(scene: Scene, size: float, rng: Generator) -> None:
    """A brushless motor's magnetic rotor stops at a random one of a dozen cogs after each run; size in nT.

    While it spins its field averages out.
    """
    name = str(rng.choice(["ballast", "battpos"]))
    runs = np.abs(np.gradient(scene.track.parameters[name])) > 1e-6
    turn = np.cumsum(np.diff(runs, prepend=runs[0]) & runs)
    angle = rng.integers(0, 12, turn[-1] + 1)[turn] * np.pi / 6.0
    shaft = direction(rng)
    a = np.cross(shaft, direction(rng))
    a /= np.linalg.norm(a)
    rests = np.outer(np.cos(angle), a) + np.outer(np.sin(angle), np.cross(shaft, a))
    still = 1.0 - first_order(runs.astype(float), scene.track.step, 1.0)
    scene.field = scene.field + size * rests * still[:, None]


def viscous(scene: Scene, size: float, rng: Generator) -> None:
    """The magnetisation of a steel plate follows the field late (magnetic viscosity); size in nT.

    The lags are minutes to hours; the magnetisation is mostly in the plane of the plate.
    """
    lags = 120.0 * 3.0 ** np.arange(5)
    unit = scene.field / np.linalg.norm(scene.field[0])
    crept = np.mean([first_order(unit, scene.track.step, float(lag)) for lag in lags], axis=0)
    normal, place = direction(rng), direction(rng)
    moment = crept - 0.9 * np.outer(crept @ normal, normal)
    own = dipole_field(np.broadcast_to(place, moment.shape), moment)
    scene.field = scene.field + size * own / MU_0_OVER_4_PI


def slip(scene: Scene, size: float, rng: Generator) -> None:
    """The battery's encoder miscounts in every move, until an end stop resets it; size in inches a move.

    It is reset every dozen moves or so.
    """
    place = scene.track.parameters["battpos"]
    way = np.abs(np.diff(place, prepend=place[0]))
    runs = np.cumsum(np.diff(way > 1e-6, prepend=False) & (way > 1e-6))
    missed = rng.normal(size=runs[-1] + 1)
    missed[rng.random(len(missed)) < 1.0 / 12.0] = np.nan
    lost = np.zeros(len(missed))
    for k in range(1, len(missed)):
        lost[k] = 0.0 if np.isnan(missed[k]) else lost[k - 1] + missed[k]
    scene.logged["battpos"] = (place + size * lost[runs], "in")


def motional(scene: Scene, size: float, rng: Generator) -> None:
    """Motion drives a current (v x B) between two metals on the hull; size in nT at 0.3 m/s across B."""
    track = scene.track
    north, east = track.local(track.latitude, track.longitude)
    v = np.gradient(np.column_stack([north, east, track.depth]), track.step, axis=0)
    ahead = rotation(track.roll, track.pitch, track.heading).apply(v, inverse=True)
    driven = np.cross(ahead, scene.field / np.linalg.norm(scene.field[0])) @ direction(rng) / 0.3
    scene.add(first_order(driven, track.step, 5.0), size * direction(rng))


def leak(scene: Scene, size: float, rng: Generator) -> None:
    """A seal leaks below a depth; the water carries a current, and takes its time to dry; size in nT."""
    deep = np.maximum(scene.track.depth / scene.track.depth.max() - rng.uniform(0.5, 0.8), 0.0)
    dries, wets = (scene.track.step / lag for lag in (rng.uniform(2000.0, 6000.0), rng.uniform(100.0, 300.0)))
    wet, leads = 0.0, np.empty(len(scene.t))
    for k, head in enumerate(deep):
        wet += 3.0 * wets * head - dries * wet
        leads[k] = wet
    scene.add(leads / max(leads.max(), 1e-9), size * direction(rng))


def discharge(scene: Scene, size: float, rng: Generator) -> None:
    """The cells in the moving battery become more magnetic as they discharge; size in nT at the end."""
    load = scene.logged["amps_a"][0] + scene.logged["amps_b"][0] + rng.uniform(0.05, 0.2)
    drawn = (np.cumsum(load) / np.sum(load)) ** rng.uniform(1.0, 2.0)
    place = scene.track.parameters["battpos"]
    nearer = 1.0 + rng.uniform(0.05, 0.15) * (place - place[0])
    scene.add(drawn * nearer**3, size * direction(rng))


def sunlit(scene: Scene, size: float, rng: Generator) -> None:
    """The sun warms a dark housing of unlogged temperature near the surface; size in nT at most."""
    shines = np.exp(-scene.track.depth / rng.uniform(3.0, 10.0))
    warm = first_order(shines, scene.track.step, float(rng.uniform(200.0, 900.0)))
    scene.add((warm - warm[0]) / np.ptp(warm), size * direction(rng))


def eccentric(scene: Scene, size: float, rng: Generator) -> None:
    """The gear of the battery's encoder is eccentric: a sinusoidal error each turn; size in inches."""
    place = scene.track.parameters["battpos"]
    turn = 2.0 * np.pi * place / rng.uniform(0.2, 0.5) + rng.uniform(0.0, 2.0 * np.pi)
    scene.logged["battpos"] = (place + size * np.sin(turn), "in")


def trailing(scene: Scene, size: float, rng: Generator) -> None:
    """The battery draws a motor's leads apart as it slides; size in nT/A, one inch from its mean position."""
    name = str(rng.choice(["amps_a", "amps_b"]))
    place = scene.track.parameters["battpos"]
    drawn = (place - np.mean(place)) * scene.logged[name][0]
    scene.add(drawn, size * direction(rng))


def compliant(scene: Scene, size: float, rng: Generator) -> None:
    """The battery's carriage yields to its weight, which the encoder does not see; size in inches at 1 g."""
    weight = np.sin(np.radians(scene.track.pitch))
    gives = first_order(weight, scene.track.step, float(rng.uniform(1.0, 4.0)))
    scene.logged["battpos"] = (scene.track.parameters["battpos"] - size * gives, "in")


def yielding(scene: Scene, size: float, rng: Generator) -> None:
    """A plastic hull creeps under pressure and recovers within the hour; size in nT once it has at depth."""
    pressed = scene.track.depth / scene.track.depth.max()
    crept = first_order(pressed, scene.track.step, float(rng.uniform(1200.0, 3600.0)))
    scene.add(crept - crept[0], size * direction(rng))


def afterglow(scene: Scene, size: float, rng: Generator) -> None:
    """The pump's brake stays energised until its relay cools, without a logged current; size in nT."""
    moved = np.abs(np.gradient(scene.track.parameters["ballast"], scene.track.step)) > 1.0
    warm = first_order(moved.astype(float), scene.track.step, float(rng.uniform(40.0, 200.0)))
    held = (warm > rng.uniform(0.05, 0.2) * max(warm.max(), 1e-9)).astype(float)
    scene.add(held, size * direction(rng))


def swarf(scene: Scene, size: float, rng: Generator) -> None:
    """Iron swarf drifts after the pumped oil and is late by up to an hour; size in nT over a stroke."""
    oil = scene.track.parameters["ballast"]
    late = first_order(oil, scene.track.step, float(rng.uniform(400.0, 3000.0)))
    scene.add((late - oil) / np.ptp(oil), size * direction(rng))


def rudder(scene: Scene, size: float, rng: Generator) -> None:
    """An unlogged rudder of steel is put over to turn, and hunts while it holds a course; size in nT."""
    step = scene.track.step
    turning = first_order(np.gradient(scene.track.heading, step), step, float(rng.uniform(2.0, 6.0)))
    hunts = 0.05 * autoregressive(rng, (len(scene.t),), 1.0, 60.0 / step)
    angle = np.radians(35.0) * np.tanh(turning / rng.uniform(0.5, 2.0) + hunts)
    a, b = direction(rng), direction(rng)
    scene.field = scene.field + size * (np.outer(np.cos(angle) - 1.0, a) + np.outer(np.sin(angle), b))


def latch(scene: Scene, size: float, rng: Generator) -> None:
    """A latching valve is thrown over near the surface, and its core stays magnetised; size in nT."""
    shallow = scene.track.depth < rng.uniform(0.05, 0.15) * scene.track.depth.max()
    surfaced = np.cumsum(np.diff(shallow, prepend=bool(shallow[0])) & shallow)
    fails = rng.random(surfaced[-1] + 1) < rng.uniform(0.0, 0.4)
    over = np.cumsum(~fails)[surfaced] % 2
    scene.add(over.astype(float), size * direction(rng))


def recovery(scene: Scene, size: float, rng: Generator) -> None:
    """Strings of the battery share a load unequally, and exchange charge for long afterwards; size in nT."""
    step = scene.track.step
    pumps = (np.abs(np.gradient(scene.track.parameters["ballast"], step)) > 1.0).astype(float)
    owed = first_order(pumps, step, float(rng.uniform(600.0, 2400.0)))
    evens = owed / max(owed.max(), 1e-9) - rng.uniform(0.2, 0.5) * first_order(pumps, step, 2.0)
    scene.add(evens, size * direction(rng))


def accumulator(scene: Scene, size: float, rng: Generator) -> None:
    """Gas shrinks with pressure (Boyle), and a steel piston follows it in jerks; size in nT."""
    charge, grip = rng.uniform(10.0, 60.0), rng.uniform(0.02, 0.1)
    piston, places = 0.0, np.empty(len(scene.t))
    for k, wanted in enumerate(scene.track.depth / (charge + scene.track.depth)):
        if abs(wanted - piston) > grip:
            piston = wanted
        places[k] = piston
    scene.add(places, size * direction(rng))


def backdriven(scene: Scene, size: float, rng: Generator) -> None:
    """The battery's weight creeps its screw back while no move holds it; size in inches an hour at 1 g.

    The encoder, on the motor's side of the clutch, does not see that. Each move takes up what has crept.
    """
    place, step = scene.track.parameters["battpos"], scene.track.step
    moves = np.abs(np.gradient(place, step)) > 1e-6
    downhill = np.sin(np.radians(scene.track.pitch)) * rng.uniform(0.7, 1.3)
    crept, off = np.empty(len(place)), 0.0
    for k, pull in enumerate(downhill):
        off = 0.0 if moves[k] else off + pull * step / 3600.0
        crept[k] = off
    scene.logged["battpos"] = (place - size * crept, "in")


def airlock(scene: Scene, size: float, rng: Generator) -> None:
    """Air in the ballast's oil is squeezed by depth (Boyle) and dissolves; size in cm^3 at the surface.

    The pump's gauge counts it as oil. While the bladder is wide the air has more room, too.
    """
    depth, oil = scene.track.depth, scene.track.parameters["ballast"]
    left = np.exp(-scene.t / scene.t[-1] * rng.uniform(0.5, 3.0))  # Henry's law: a share of it an hour
    squeezed = 1.0 - 10.0 / (10.0 + depth)
    room = 1.0 + rng.uniform(0.1, 0.4) * (oil - oil.mean()) / max(float(np.ptp(oil)), 1e-9)
    scene.logged["ballast"] = (oil + size * left * squeezed * room, "cm3")


def solar(scene: Scene, size: float, rng: Generator) -> None:
    """Panels on the hull charge the battery, by heading, through clouds and clear water; size in nT."""
    track, reach = scene.track, rng.uniform(8.0, 25.0)
    azimuth, height = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.3, 1.0)
    sun = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), -np.sin(height)])
    normal = np.array([0.0, 0.5 * rng.choice([-1.0, 1.0]), -0.9])
    faces = np.maximum(rotation(track.roll, track.pitch, track.heading).apply(normal) @ sun, 0.0)
    clouds = 1.0 / (1.0 + np.exp(2.0 * autoregressive(rng, (len(scene.t),), 1.0, 600.0 / track.step)))
    scene.add(faces * clouds * np.exp(-(track.depth - track.depth.min()) / reach), size * direction(rng))


def jettison(scene: Scene, size: float, rng: Generator) -> None:
    """Iron shot leaks out of its box for a while, and takes its induced moment along; size in nT in all.

    What is left of it is magnetised along the field, so what it does turns with the vehicle.
    """
    began, lasts = scene.t[-1] * rng.uniform(0.2, 0.7), scene.t[-1] * rng.uniform(0.02, 0.2)
    lost = np.clip((scene.t - began) / lasts, 0.0, 1.0)
    unit = scene.field / np.linalg.norm(scene.field[0])
    own = dipole_field(np.broadcast_to(direction(rng), unit.shape), unit)
    scene.field = scene.field - size * lost[:, None] * own / MU_0_OVER_4_PI
