"""Test that corrected lines give a levelled map equal to the true field, with a valid sigma."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from commands import Command
from msgspec import structs
from rock import Rock
from voyages import GLIDER, PLACE, Map, sail, synthetic, track_over

from magbridge.arrays import FloatArray
from magbridge.estimation.gaussian_field import GaussianField
from magbridge.estimation.nodes import nodes_near
from magbridge.field.geodesy import offset, separation
from magbridge.field.read import read_grid
from magbridge.survey import gridding
from magbridge.survey.maps import anomaly_map
from magbridge.survey.read import read_table
from magbridge.survey.run import Result, survey
from magbridge.survey.samples import Roughness, Rows, Samples, crossovers

ORIGIN = 49.5, -57.9
NOISE = 1.5


def rock_of(seed: int) -> Rock:
    return Rock(np.random.default_rng(seed), 50.0, 900.0)


def lines(rock: Rock, rng: np.random.Generator) -> Samples:
    """Return ten lines north and three ties east, each with its own level (20 nT, 1-sigma)."""
    places, label, tie, level = [], [], [], []
    along = np.arange(-3000.0, 3000.0, 120.0)
    for k, across in enumerate([*np.linspace(-2700, 2700, 10), -2000.0, 100.0, 2100.0]):
        wander = across + 40.0 * np.sin(along / 700.0 + k)
        places.append(np.stack([along, wander] if k < 10 else [wander, along], axis=1))
        label += [k] * len(along)
        tie += [k >= 10] * len(along)
        level += [rng.normal(0, 20.0)] * len(along)
    place = np.concatenate(places)
    value = rock.at(place) + np.array(level) + rng.normal(0, NOISE, len(place))
    n = len(place)
    return Samples(place, np.zeros(n), np.full(n, np.nan), value, np.array(label), np.array(tie), ORIGIN)


@pytest.fixture(scope="module")
def done() -> tuple[Rock, Result]:
    rock = rock_of(5)
    return rock, survey(lines(rock, np.random.default_rng(6)))


def test_levels_are_found_at_the_crossovers(done: tuple[Rock, Result]) -> None:
    """Thirty crossings; their mis-ties fall from the levels' size to the noise's."""
    _, result = done
    assert len(result.before) == 30
    assert np.std(result.before) > 15.0
    assert np.std(result.after) < 2.0 * NOISE


def test_map_is_right_within_its_sigma(done: tuple[Rock, Result]) -> None:
    """Between the lines, without the common level of all lines."""
    rock, result = done
    at = np.random.default_rng(7).uniform(-2500, 2500, (400, 2))
    anomaly, sigma = result.gridded.evaluate(at)
    error = anomaly - rock.at(at)
    error -= error.mean()
    assert np.sqrt(np.mean(error**2)) < 6.0
    assert 0.6 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.4
    assert result.gridded.sigma == pytest.approx(NOISE, rel=0.25)


@pytest.mark.parametrize(("noise", "rise"), [(0.02, 0.0), (0.2, 0.0), (0.02, 2.0)])
def test_map_of_a_dense_and_precise_survey_has_the_sigma_of_its_errors(noise: float, rise: float) -> None:
    """A drone over six deep sources: a field of thousand times the noise needs finer nodes.

    A height that varies by 4 m changes the field by 30 times the noise.
    """
    rng = np.random.default_rng(3)
    sources, moments = rng.uniform(-900.0, 1500.0, (6, 2)), rng.normal(size=6)

    def field(place: FloatArray, deeper: FloatArray | float = 0.0) -> FloatArray:
        r2, h = ((place[:, None] - sources) ** 2).sum(axis=-1), 400.0 - np.reshape(deeper, (-1, 1))
        return np.asarray(60.0 * 400.0**2 * h * (h**2 + r2) ** -1.5 @ moments)

    along = np.arange(-300.0, 1500.0, 2.0)
    legs = [np.stack([along, np.full(len(along), 60.0 * k)], axis=1) for k in range(8)]
    ties = [np.stack([np.full(len(along), north), along - 600.0], axis=1) for north in (200.0, 600.0, 1000.0)]
    place = np.concatenate([*legs, *ties])
    label = np.repeat(np.arange(11), len(along))
    n = len(place)
    depth = rise * np.sin(np.arange(n) / 90.0)
    samples = Samples(
        place, depth, np.full(n, np.nan), field(place, depth) + rng.normal(0.0, noise, n), label,
        label >= 8, ORIGIN,
    )  # fmt: skip
    found = survey(samples).gridded
    at = rng.uniform([0.0, 0.0], [1200.0, 420.0], (400, 2))
    anomaly, sigma = found.evaluate(at)
    error = anomaly - field(at, found.middle)
    error -= error.mean()
    assert np.sqrt(np.mean(error**2)) < 0.5 * noise
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 2.0
    assert found.sigma == pytest.approx(noise, rel=0.1)


def test_far_from_the_lines_nothing_is_known(done: tuple[Rock, Result]) -> None:
    _, result = done
    _, sigma = result.gridded.evaluate(np.array([[40_000.0, 0.0]]))
    assert sigma[0] == pytest.approx(
        result.gridded.size * result.gridded.roughness.evaluate(np.array([[4e4, 0.0]]))
    )


def test_a_map_is_continued_upward_with_its_sigma(done: tuple[Rock, Result]) -> None:
    """600 m up every wave of the field has decayed by its wave number; the error agrees with sigma.

    So it is near the edge, where what lies beyond comes in: the survey's own sigma does not know of that.
    """
    rock, result = done
    grid = anomaly_map(result.gridded, result.samples, altitude=600.0)
    assert grid.altitude == pytest.approx(600.0)
    assert grid.sigma is not None
    y, x = np.meshgrid(grid.latitude, grid.longitude, indexing="ij")
    place = np.stack(separation(*ORIGIN, y.ravel(), x.ravel()), axis=1)
    true = rock.at(place, -600.0)
    off, sigma = grid.anomaly.ravel() - true, grid.sigma.ravel()
    middle, edge = (np.abs(place) < 1500.0).all(axis=1), (np.abs(place) < 2700.0).all(axis=1)
    edge &= ~middle
    error = off - off[middle].mean()
    assert np.std(true[middle]) < 0.65 * np.std(rock.at(place)[middle])
    assert np.std(error[middle]) < 0.1 * np.std(true[middle])
    assert 0.3 < np.sqrt(np.mean((error / sigma)[middle] ** 2)) < 1.3
    assert 0.6 < np.sqrt(np.mean((error / sigma)[edge] ** 2)) < 1.3
    assert np.median(sigma[edge]) > 1.5 * np.median(sigma[middle])


def test_map_of_a_vehicle_that_dives_is_right_between_its_tracks() -> None:
    """Rock at 1 km (waves k of power k² exp(-2 k 1000)) over which a glider dives to 140 m and climbs."""
    rng = np.random.default_rng(2)
    n, legs = 2400, 12
    course = np.cumsum(rng.uniform(1.5, 3.0, legs))[np.arange(n) * legs // n]
    place = np.cumsum(4.0 * np.stack([np.cos(course), np.sin(course)], axis=1), axis=0)
    depth = 140.0 * np.abs(np.arange(n) % 300 / 150.0 - 1.0)
    number, (way, phase) = rng.gamma(4.0, 1 / 2000.0, 1500), rng.uniform(0.0, 2.0 * np.pi, (2, 1500))
    rock, middle = Rock.of_waves(40.0, number, way, phase), float(np.median(depth))
    value = rock.at(place, depth - middle) + rng.normal(0.0, 1.0, n)
    zero = np.zeros(n, int)
    result = survey(Samples(place, depth, np.arange(4.0, 4 * n + 4, 4), value, zero, zero > 0, ORIGIN))
    found = result.gridded
    assert found.field.harmonic
    # crossings at different depths are compared at one depth
    assert np.sqrt(np.mean(result.found.misties(value) ** 2)) > 3.0
    assert np.sqrt(np.mean(result.after**2)) < 2.0
    assert "misties_remain" not in [warning.code for warning in result.warnings]
    at = place[rng.integers(n, size=400)] + rng.normal(0.0, 250.0, (400, 2))
    anomaly, sigma = found.evaluate(at)
    error = anomaly - rock.at(at)
    error -= np.mean(found.evaluate(place[::10])[0] - rock.at(place[::10]))
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 1.4
    assert np.sqrt(np.mean(error**2)) < 2.2


def zigzag(rng: np.random.Generator, *, back: bool) -> tuple[Samples, FloatArray, FloatArray]:
    """Return three hours of a corrected zigzag over a field of 30 nT, the field, and a quiet day's change."""
    n, legs = 1200, 6
    leg = np.arange(n) * legs // n
    course = np.radians(np.where(leg % 2, 50.0, -50.0) + 180.0 * (back & (leg >= legs // 2)))
    place: FloatArray = 4.0 * np.cumsum(np.stack([np.cos(course), np.sin(course)], axis=1), axis=0)
    rock = Rock(rng, 30.0, 900.0, 300).at(place)
    time, zero = np.linspace(0.0, 10_800.0, n), np.zeros(n, int)
    value = rock + rng.normal(0, 1.0, n)
    change = 4.0 * np.cos(np.pi * time / time[-1])
    return Samples(place, np.zeros(n), time, value, zero, zero > 0, ORIGIN), rock, change


def test_a_field_along_a_track_without_crossings_is_not_a_change_with_time() -> None:
    """One is as likely as the other there: with changes of any size the map was off by 6 nT."""
    samples, rock, _ = zigzag(np.random.default_rng(4), back=False)
    done = survey(samples)
    anomaly, sigma = done.gridded.evaluate(samples.place)
    assert np.std(anomaly - rock) < 0.3
    assert np.std(anomaly - rock) < 1.25 * np.median(sigma)
    assert [warning.code for warning in done.warnings] == ["no_crossing_track"]


def test_a_change_with_time_that_crossings_show_is_not_in_the_map() -> None:
    samples, rock, change = zigzag(np.random.default_rng(4), back=True)
    done = survey(replace(samples, value=samples.value + change))
    found = done.gridded
    anomaly, sigma = found.evaluate(samples.place)
    assert not done.warnings
    assert np.std(found.levels - change) < 0.2 * np.std(change)
    assert np.std(anomaly - rock) < 1.25 * np.median(sigma)


def test_where_a_track_jumps_the_map_is_as_uncertain_as_its_places() -> None:
    """A fix moves the second half by 600 m: the contradiction is not a change with time."""
    samples, rock, _ = zigzag(np.random.default_rng(4), back=True)
    place = samples.place.copy()
    place[500:, 0] += 600.0
    found = survey(replace(samples, place=place)).gridded
    anomaly, sigma = found.evaluate(samples.place)
    error = anomaly - rock
    assert np.std(error[:500]) < 0.5
    assert np.std(error[500:]) > 5.0
    error -= error.mean()
    assert 0.4 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.4


def test_slow_changes_include_the_daily_variation_of_half_a_day() -> None:
    """Half waves alone have no slope at the ends: they were 2 nT off there."""
    samples, _, _ = zigzag(np.random.default_rng(4), back=False)
    time = 4.0 * samples.time
    *_, slow = gridding.level_blocks(replace(samples, time=time))
    columns, daily = slow.functions[:], 30.0 * np.sin(2.0 * np.pi * time / 86_400.0 + 0.5)
    columns = np.column_stack([columns, np.ones(len(time))])
    error = daily - columns @ np.linalg.lstsq(columns, daily)[0]
    assert np.abs(error).max() < 0.1


def pausing(rock: Rock, shift: float) -> Samples:
    """Return one log of three lines north and two ties east at 2.5 m/s, with a pause of 250 s after each.

    The way to the first tie is 3.8 km. The true places of the ties are `shift` m north of those logged.
    """
    along, legs = np.arange(-1500.0, 1500.0, 25.0), []
    for k, across in enumerate([-1200.0, 0.0, 1200.0, 1200.0, -1200.0]):
        leg = np.stack([along, np.full(len(along), across)], axis=1)[:: -1 if k % 2 else 1]
        legs.append(leg if k < 3 else -leg[:, ::-1])
    place, n = np.concatenate(legs), 5 * len(along)
    time = 10.0 * np.arange(n) + 250.0 * (np.arange(n) // len(along))
    off = shift * (np.arange(n) >= 3 * len(along))[:, None] * [1.0, 0.0]
    value = rock.at(place + off) + np.random.default_rng(6).normal(0.0, NOISE, n)
    return Samples(place, np.zeros(n), time, value, np.zeros(n, int), np.zeros(n, bool), ORIGIN)


def test_a_way_in_a_pause_of_the_log_is_neither_a_line_nor_an_error() -> None:
    """It crosses all lines; its length made the sigma as large as the field, at an error below the noise."""
    rock = rock_of(5)
    done = survey(pausing(rock, 0.0))
    assert len(done.found.place) == 6
    assert not done.warnings
    at = done.samples.place
    anomaly, sigma = done.gridded.evaluate(at)
    error = anomaly - rock.at(at)
    error -= error.mean()
    assert np.std(error) < 0.5 * NOISE
    assert 0.6 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.5


def test_a_jump_whose_places_contradict_each_other_is_a_warning() -> None:
    done = survey(pausing(rock_of(5), 300.0))
    assert "doubtful_places" in [warning.code for warning in done.warnings]
    assert np.median(done.gridded.evaluate(done.samples.place)[1]) > 5.0 * NOISE


def test_crustal_field_is_searched_over_more_than_the_middle_of_a_dense_log(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A hundred samples a kilometre: the few about the middle one are on one leg, which tells no length."""
    rng, rock = np.random.default_rng(8), rock_of(8)
    corners = rng.uniform(-3000.0, 3000.0, (8, 2))
    at = np.concatenate([np.linspace(a, b, 500) for a, b in pairwise(corners)])
    n = len(at)
    value = rock.at(at) + rng.normal(0, NOISE, n)
    samples = Samples(
        at, np.zeros(n), np.linspace(0.0, 14_000.0, n), value, np.zeros(n, int), np.zeros(n, bool), ORIGIN
    )
    monkeypatch.setattr(gridding, "SEARCHED", 350)
    found = gridding.gridded(samples)
    assert 600.0 < found.field.length < 1500.0
    assert found.size == pytest.approx(50.0, rel=0.4)


def test_noise_is_not_correlated_across_a_gap() -> None:
    """Neither in time, nor in place if the time is not known."""
    samples, _, _ = zigzag(np.random.default_rng(4), back=False)
    samples = samples.part(np.delete(np.arange(600), np.s_[200:300]))
    field = GaussianField(nodes_near(samples.place, 400.0, 400.0), 900.0, 4)
    for one in (samples, replace(samples, time=np.full(500, np.nan))):
        rows = Rows(one, gridding.level_blocks(one), Roughness.uniform())
        assert rows.sums(field, np.arange(500)).pairs == 498


def test_crossing_is_where_the_lines_cross() -> None:
    """Two straight lines; the value there is interpolated on each."""
    t = np.linspace(0.0, 100.0, 11)
    place = np.concatenate([np.stack([t, 0 * t + 33.0], axis=1), np.stack([0 * t + 52.0, t], axis=1)])
    zero = np.zeros(22)
    found = crossovers(Samples(place, zero, zero, zero, np.repeat([0, 1], 11), zero > 0, ORIGIN))
    np.testing.assert_allclose(found.place, [[52.0, 33.0]])
    np.testing.assert_allclose(found.misties(place.sum(axis=1)), [0.0], atol=1e-9)


@pytest.fixture
def table(tmp_path: Path) -> Path:
    samples = lines(rock_of(5), np.random.default_rng(6))
    latitude, longitude = offset(*ORIGIN, samples.place[:, 0], samples.place[:, 1])
    kind = np.where(samples.tie, "TIE", "LINE")
    rows = zip(longitude, latitude, samples.value, samples.line, kind, strict=True)
    text = "\n".join(f"{x:.8f},{y:.8f},{v:.3f},{k},{t}" for x, y, v, k, t in rows)
    (tmp_path / "lines.csv").write_text(f"longitude,latitude,anomaly,line,line_type\n{text}\n")
    return tmp_path / "lines.csv"


def test_tie_lines_of_a_log_with_times_are_those_of_the_table(command: Command, table: Path) -> None:
    heading, *rows = table.read_text().splitlines()
    timed = [f"time,{heading}", *(f"{1.6e9 + k},{row}" for k, row in enumerate(rows))]
    (table.parent / "timed.csv").write_text("\n".join(timed) + "\n")
    found = [
        command.json("survey", file, "-o", table.parent / "map.nc")
        for file in (table, table.parent / "timed.csv")
    ]
    assert found[0]["misties_after_nT"] == pytest.approx(found[1]["misties_after_nT"], rel=1e-6)


def test_command_makes_a_map_that_navigate_reads(command: Command, table: Path) -> None:
    """Write GeoTIFF, tracks and crossovers as well; the map equals the survey."""
    out = table.parent
    output = command(
        "survey", table, "-o", out / "map.nc", "--geotiff", out / "map.tif", "--tracks", out / "t.geojson",
        "--crossovers", out / "x.csv", "--json",
    )  # fmt: skip
    facts = json.loads(output.out)
    assert facts["crossovers"] == 30
    assert facts["misties_after_nT"] < 0.2 * facts["misties_before_nT"]
    grid = read_grid(out / "map.nc")
    rock = rock_of(5)
    y, x = np.meshgrid(grid.latitude[20:-20], grid.longitude[20:-20], indexing="ij")
    north, east = separation(*ORIGIN, y.ravel(), x.ravel())
    inner = (np.abs(north) < 2500) & (np.abs(east) < 2500)
    error = grid.anomaly[20:-20, 20:-20].ravel()[inner] - rock.at(np.stack([north, east], axis=1))[inner]
    assert np.std(error) < 6.0
    flat = read_grid(out / "map.tif")
    assert flat.anomaly.shape == grid.anomaly.shape
    np.testing.assert_allclose(flat.longitude, grid.longitude, atol=1e-9)
    assert len(json.loads((out / "t.geojson").read_text())["features"]) == 13
    assert len((out / "x.csv").read_text().splitlines()) == 31


def test_command_predicts_at_points(command: Command, table: Path) -> None:
    points = table.parent / "points.csv"
    points.write_text("longitude,latitude\n-57.9,49.5\n-57.89,49.51\n")
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:201]))  # four lines of ten
    facts = command.json("survey", table, "--predict", points, "-o", table.parent / "out.csv")
    rows = (table.parent / "out.csv").read_text().splitlines()
    assert rows[0] == "longitude,latitude,anomaly [nT],anomaly_sigma [nT],level_sigma [nT]"
    assert len(rows) == 3
    assert float(rows[1].split(",")[-1]) == pytest.approx(facts["level_sigma_nT"], abs=1e-3)
    points.write_text("longitude,latitude\n-57.9,49.5\n,49.51\n")
    error = command("survey", table, "--predict", points, "-o", table.parent / "none.csv", code=1).err
    assert "points.csv: expected longitude and latitude in every row, 1 lack one" in error
    assert not (table.parent / "none.csv").exists()


def test_rows_without_a_line_are_one(tmp_path: Path) -> None:
    for first, second in (("L1", "L2"), ("10", "20")):
        rows = "".join(f"{1 + k / 1e4},2,{k},{(first, '', second)[k % 3]}\n" for k in range(30))
        (tmp_path / "lines.csv").write_text(f"longitude,latitude,anomaly,line\n{rows}")
        assert np.bincount(read_table(tmp_path / "lines.csv").line).tolist() == [10, 10, 10]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("longitude,latitude,anomaly\n1,2,3\n", "only 1 row with longitude, latitude and anomaly"),
        ("longitude,anomaly\n1,2\n", "expected this column; there are: longitude anomaly"),
        ("longitude,latitude,anomaly\n1,2,three\n", "expected numbers"),
    ],
)
def test_a_bad_table_is_one_line(command: Command, tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "bad.csv").write_text(text)
    output = command("survey", tmp_path / "bad.csv", "-o", tmp_path / "map.nc", code=1)
    assert words in output.err
    assert output.err.count("\n") == 1
    assert not (tmp_path / "map.nc").exists()


def test_a_vehicle_finds_itself_on_the_map_that_its_own_survey_drew() -> None:
    """Between the tracks the map's errors last for hundreds of metres. Counted again with every sample they
    made the filter sure of a wrong place; a level removed from the map left the field unexplained by it.
    """
    rock = synthetic(Map(40, 1000), 2)
    flown = track_over(rock, GLIDER, 2, hours=4.0)
    longitude, latitude = flown["truth_longitude"].to_numpy(), flown["truth_latitude"].to_numpy()
    n = len(latitude)
    level = -70.0
    value = rock.anomaly_at(longitude, latitude) + level + np.random.default_rng(9).normal(0.0, 1.0, n)
    place = np.stack(separation(*PLACE, latitude, longitude), axis=1)
    samples = Samples(
        place, np.zeros(n), flown["time"].to_numpy(), value, np.zeros(n, int), np.zeros(n, bool), PLACE,
        level_sigma=100.0,
    )  # fmt: skip
    drawn = anomaly_map(survey(samples).gridded, samples)
    assert np.mean(drawn.anomaly_at(longitude, latitude)) == pytest.approx(np.mean(value), abs=0.3)
    found = sail(flown, drawn, structs.replace(GLIDER, start_sigma=50.0)).score()
    assert not found["lost"]
    assert found["drms"] < 0.4 * found["unaided"]
    assert found["nees"] < 2.0
    assert found["valid"] > 0.5
