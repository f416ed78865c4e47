"""Test wrong references: the published field keeps its accuracy, and the bridge reports the error."""

from math import nan

import numpy as np
import pytest
from worlds import World, calibration, error_of, grid_of, learn

from magbridge.learning import Learner
from magbridge.records import Quality


def reported(learner: Learner) -> list[str]:
    """Return the texts of the learner's messages."""
    return [notice.text for notice in learner.notices]


@pytest.mark.parametrize(("scale", "shift"), [(-1.0, 0.0), (1.0, 1000.0)])
def test_a_wrong_map_teaches_nothing_wrong(scale: float, shift: float) -> None:
    """Inverted, or off by a kilometre as a false GPS: the published field keeps its accuracy."""
    known = calibration()
    world = World(known, 1500)
    learner = Learner(known, grid=grid_of(scale, shift), spread=20.0)
    learn(learner, world)
    assert error_of(learner.calibration, world) < 1.3


def test_a_map_that_is_wrong_by_no_more_than_the_crustal_field_is_reported() -> None:
    """Upside down, twice: the bridge goes on without it, and sigma need not grow."""
    known, doubted = calibration(), {}
    for scale in (-2.0, 1.0):
        learner = Learner(known, grid=grid_of(scale), spread=20.0)
        doubted[scale] = learn(learner, World(known, 1000))
        if scale < 0.0:
            assert learner.state.causes == ("map_error",)
            assert learner.variance < 2.0
            assert learner.calibration is known
            assert len([text for text in reported(learner) if text.startswith("unexplained")]) == 1
    assert doubted[1.0] == []
    assert doubted[-2.0]


def test_another_sheet_for_a_while_is_not_learned() -> None:
    """The level of another sheet is 80 nT off: nothing is learned from it, and the alarm ends by itself."""
    known, n = calibration(), 1900
    right, wrong = grid_of(1.0), grid_of(1.0, level=80.0)
    world, learner = World(known, n), Learner(known, grid=right, spread=20.0)

    def change(k: int) -> None:
        learner._grid = wrong if 400 <= k < 700 else right

    doubted = learn(learner, world, seen=change)
    assert 401 <= doubted[0] <= 404
    assert learner.calibration is known
    assert len([text for text in reported(learner) if text.startswith("unexplained")]) == 1
    assert learner.flags == 0


def test_a_month_without_a_fix_changes_nothing() -> None:
    """The bridge reports the missing fix once and keeps the published calibration."""
    known = calibration()
    learner, world = Learner(known), World(known, 600)
    learn(learner, world)
    before = learner.calibration
    field = tuple(world.field[0].tolist())
    for hour in range(24 * 30):
        learner.sample(
            2_400_000_000 + hour * 3_600_000_000, field, [1.0, 0.5, 0.25], (0.5,), 0,
            faulty=False, reference=nan, position=None, watched=(nan,),
        )  # fmt: skip
    assert learner.calibration is before
    reported = [notice.text for notice in learner.notices if "hour" in notice.text]
    assert reported == ["learning: an hour without a sample to learn from"]


def test_a_spoofed_current_is_not_learned_from() -> None:
    """Telemetry that jumps at random has nothing to do with the field: no term of it is published."""
    known, rng = calibration(), np.random.default_rng(4)
    learner = Learner(known, currents=("pump_current",))
    learn(
        learner,
        World(known, 1200),
        watched=np.column_stack([np.full(1200, nan), 50.0 * rng.normal(size=1200)]),
    )
    assert learner.calibration.effects == ()
    assert learner.flags == 0


def test_a_map_in_other_units_is_reported() -> None:
    """The map is ten times too strong: the report names it, and the first calibration is published."""
    known, n = calibration(), 600
    world, learner = World(known, n), Learner(known, grid=grid_of(10.0, 1000.0), spread=20.0)
    doubted = learn(learner, world)
    assert len(doubted) > n // 2
    assert learner.state.causes == ("map_error",)
    assert learner.calibration is known
    assert error_of(learner.learned(), world) < 3.0


@pytest.mark.parametrize("mapped", [False, True])
def test_a_gps_that_jumps_by_a_kilometre_teaches_nothing(*, mapped: bool) -> None:
    """GPS jumps to and fro, with and without a map."""
    known, n = calibration(), 1200
    world = World(known, n)
    world.where = [
        (latitude + 1000.0 / 111_000.0 * (400 <= k < 800), longitude)
        for k, (latitude, longitude) in enumerate(world.track)
    ]
    learner = Learner(known, grid=grid_of(1.0) if mapped else None, spread=20.0 if mapped else 145.0)
    learn(learner, world)
    assert learner.calibration is known
    assert error_of(known, world) < 1.1


@pytest.mark.parametrize("lie", ["random", "frozen"])
def test_a_mass_with_wrong_telemetry_is_one_alarm_until_it_ends(lie: str) -> None:
    """The bridge reports one alarm; sigma covers the error from the fifth sample on."""
    known, n = calibration(), 1500
    world, rng = World(known, n), np.random.default_rng(5)
    truth, told = world.mass.copy(), slice(600, 900)
    world.mass[told] = rng.uniform(-1.0, 1.0, 300) if lie == "random" else world.mass[599]
    learner, beyond = Learner(known), []

    def check(k: int) -> None:
        A, T = learner.calibration.matrices(world.mass[k, None, None])
        error = float(np.linalg.norm(A[0] @ (world.field[k] - T[0]))) - world.total[k]
        if abs(error) > 3.0 * np.sqrt(learner.variance + 4.0):
            beyond.append(k)

    doubted = learn(learner, world, seen=check)
    assert doubted[0] <= 603  # two outliers raise no alarm, and telemetry is awaited
    assert sum(600 <= k < 900 for k in doubted) >= 290
    assert len(beyond) <= 5
    announced = [text.split(":")[0] for text in reported(learner)]
    assert announced.count("unexplained") <= 2
    assert announced[-1] == "explained again"
    assert learner.calibration is known
    assert learner.variance == 0.0
    world.mass = truth
    assert error_of(learner.calibration, world) < 1.3


def test_telemetry_that_is_late_is_reported() -> None:
    """Telemetry is 8 s late: two samples before the report of a motion are outliers that fit the report."""
    known, n = calibration(), 400
    world = World(known, n)
    late = np.concatenate([world.mass[:2], world.mass[:-2]])
    moved = np.flatnonzero(np.diff(world.mass)) + 1
    faulty = late != world.mass
    world.mass = late
    learner = Learner(known)
    doubted = learn(learner, world, faulty=faulty)
    assert doubted[0] == moved[0] + 3  # as soon as it is reported, and of two samples
    assert learner.state.causes == ("clock_offset",)
    assert learner.state.since_us == (moved[0] + 1) * 4_000_000
    assert learner.calibration is known
    assert [text for text in reported(learner) if "clock offset" in text] == reported(learner)


def test_a_motion_that_began_before_its_telemetry_raises_no_alarm() -> None:
    """The last sample before each is off by 15 nT without a flag, as no telemetry could know."""
    known, n = calibration(), 1500
    world, added = World(known, n), np.zeros((n, 3))
    moving = np.diff(world.mass, prepend=world.mass[0]) != 0.0
    added[:-1][moving[1:]] = [0.0, 0.0, 15.0]
    learner = Learner(known)
    assert not learn(learner, world, added=added, quality=np.where(moving, int(Quality.MOVING), 0))
    assert not [text for text in reported(learner) if "unexplained" in text]
    assert error_of(learner.calibration, world) < 1.1


def test_two_outliers_raise_no_alarm() -> None:
    """Two outliers raise no alarm; three consistent ones do."""
    known, n = calibration(), 400
    added = np.zeros((n, 3))
    added[350:352] = [0.0, 0.0, 40.0]
    assert learn(Learner(known), World(known, n), added=added) == []
    added[350:] = [0.0, 0.0, 40.0]
    assert learn(Learner(known), World(known, n), added=added)[0] == 353
