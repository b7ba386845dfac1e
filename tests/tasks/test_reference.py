"""References as tables: published shapes, derivatives, flatness, laps, families, and infeasible references."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import at, replace_fields
from retrim.physics import Command, PointMass, State, kingfisher, small, with_payload
from retrim.tasks import REFERENCES, Reference, join_references, smooth_start
from retrim.tasks.reference import POINTS
from retrim.tasks.shapes import AT_SPEED, circle, figure8, star

PERIODS = {"circle": 3.0, "figure8": 5.0, "lissajous": 5.5, "star": 6.0}
RAMP = 3.0
BOUNDS = {  # of the lap: lowest and highest x, then y
    "circle": ((0.0, 2.0), (-1.0, 1.0)),
    "figure8": ((0.0, 3.0), (-0.5, 0.5)),
    "lissajous": ((0.0, 2.0), (-0.5, 0.5)),
    "star": ((0.0, 1.0 + math.cos(math.radians(36.0))), (-math.sin(math.radians(72.0)), math.sin(math.radians(72.0)))),
}
CORNERS = [1.0 + np.exp(1j * (math.pi + k * math.radians(72.0))) for k in range(5)]  # of the star, x + i y

names = pytest.mark.parametrize("name", REFERENCES)


@pytest.fixture(scope="module")
def tables():
    return {name: make() for name, make in REFERENCES.items()}


def at_one(reference, t):
    return jax.tree.map(lambda leaf: leaf[0], at(reference, [t]))


def row_times(reference):
    return float(reference.every) * np.arange(reference.rows.shape[0])


def line(t):
    return [t, 0.0, 1.0]


# ---- the three shapes of the paper


@names
def test_starts_at_rest_at_origin(name, tables):
    here = at_one(tables[name], 0.0)
    np.testing.assert_allclose(here.p, [0.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(here.v, 0.0, atol=1e-6)
    np.testing.assert_allclose(here.u, [9.81, 0.0, 0.0, 0.0], atol=1e-4)
    assert here.heading == 0.0


@names
def test_repeats_with_its_period_only(name, tables):
    reference, period = tables[name], PERIODS[name]
    assert float(reference.lap[1] - reference.lap[0]) == period
    times = RAMP + period * np.linspace(0.0, 0.99, 57)
    first = at(reference, times)
    for laps in (1, 2, 40):
        later = at(reference, times + laps * period)
        for a, b in zip(first, later, strict=True):
            np.testing.assert_allclose(b, a, atol=1e-8)
    for part in (0.2, 0.5):
        assert np.abs(at(reference, times + part * period).p - first.p).max() > 0.3


@names
def test_extent(name, tables):
    lap = at(tables[name], RAMP + PERIODS[name] * np.linspace(0.0, 1.0, 3000)).p
    for axis in (0, 1):
        low, high = BOUNDS[name][axis]
        assert float(lap[:, axis].min()) == pytest.approx(low, abs=0.01)
        assert float(lap[:, axis].max()) == pytest.approx(high, abs=0.01)
    np.testing.assert_array_equal(tables[name].rows[:, 2], 1.0)


def test_circle_has_constant_radius_and_starts_towards_minus_y(tables):
    points = np.asarray(at(tables["circle"], np.linspace(0.0, 6.0, 500)).p)
    np.testing.assert_allclose(np.hypot(points[:, 0] - 1.0, points[:, 1]), 1.0, atol=1e-4)
    assert points[100, 1] < -0.01


def test_star_has_five_corners_and_straight_edges(tables):
    times = row_times(tables["star"])
    lap = np.asarray(tables["star"].rows)[times >= RAMP]
    z = lap[:, 0] + 1j * lap[:, 1]
    for corner in CORNERS:
        assert np.abs(z - corner).min() < 0.01
    assert np.abs(z - 1.0).max() <= 1.0 + 1e-9
    # the line of an edge passes the centre at cos 72 of the radius
    v = lap[:, 3] + 1j * lap[:, 4]
    straight = np.abs(np.abs(v) - 1.585) < 1e-3
    assert straight.mean() > 0.95
    offset = np.imag((z - 1.0) * np.conj(v))[straight] / np.abs(v[straight])
    np.testing.assert_allclose(np.abs(offset), math.cos(math.radians(72.0)), atol=1e-6)


def test_speeds_after_spin_up(tables):
    for name, speed in (("circle", 2.0 * math.pi / 3.0), ("star", 1.585)):
        v = np.asarray(tables[name].rows)[row_times(tables[name]) >= RAMP, 3:6]
        speeds = np.linalg.norm(v, axis=1)
        assert np.median(speeds) == pytest.approx(speed, abs=1e-3)
        assert np.percentile(speeds, 95) - np.percentile(speeds, 5) < 2e-3


def test_start_is_smooth():
    times = np.linspace(0.0, 4.0, 4001)
    path = np.array([smooth_start(float(t)) for t in times])
    assert (np.diff(path) >= 0.0).all()
    rate = np.gradient(path, times)
    assert path[0] == 0.0
    assert rate[0] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(rate[times > 3.0], 1.0, atol=1e-6)
    assert np.abs(np.diff(rate)).max() < 1e-3  # the velocity is continuous
    assert path[-1] == pytest.approx(1.5 + 1.0)


# ---- continuity and derivatives


@names
def test_position_is_continuous_across_lap(name, tables):
    """No step is longer than the fastest speed allows, including that between laps."""
    reference, end = tables[name], RAMP + PERIODS[name]
    fastest = float(np.linalg.norm(np.asarray(reference.rows)[:, 3:6], axis=1).max())
    times = np.linspace(0.0, end + PERIODS[name] + 0.5, 6000)
    steps = np.linalg.norm(np.diff(np.asarray(at(reference, times).p), axis=0), axis=1)
    assert steps.max() < 1.01 * fastest * (times[1] - times[0]) + 1e-4
    for seam in (end, end + PERIODS[name]):
        before, after = at_one(reference, seam - 1e-9), at_one(reference, seam + 1e-9)
        for a, b, near in zip(before, after, (5e-5, 2e-4, 2e-3, 0.0, 2e-3, 0.1, 0.0), strict=True):
            np.testing.assert_allclose(b, a, atol=near)


@names
def test_velocity_is_derivative_of_position(name, tables):
    rows, every = np.asarray(tables[name].rows), float(tables[name].every)
    slopes = (rows[2:, :3] - rows[:-2, :3]) / (2.0 * every)
    wrong = np.linalg.norm(slopes - rows[1:-1, 3:6], axis=1)
    if name == "star":  # a corner has no derivative
        near = np.abs((rows[1:-1, 0] + 1j * rows[1:-1, 1])[:, None] - np.array(CORNERS)[None]).min(axis=1) < 0.03
        assert near.mean() < 0.15
        wrong = wrong[~near]
    assert wrong.max() < 1e-3
    assert np.linalg.norm(rows[:, 3:6], axis=1).max() > 1.0  # the bound is meaningful


def test_interpolates_linearly_between_rows(tables):
    reference = tables["circle"]
    t = (100.0 + 0.25) * float(reference.every)
    mixture = 0.75 * reference.rows[100] + 0.25 * reference.rows[101]
    here = at_one(reference, t)
    np.testing.assert_allclose(jnp.concatenate([jnp.atleast_1d(leaf) for leaf in here]), mixture, atol=1e-12)


# ---- headings over several turns


def heading_along_path(phase):
    """Return a circle of 3 s whose heading follows the path, wrapped or not; ``phase`` is its beginning."""

    def path(t, fold):
        phi = 2.0 * math.pi * smooth_start(t) / 3.0
        heading = phi - 0.5 * math.pi + phase
        return [1.0 - math.cos(phi), -math.sin(phi), 1.0, math.atan2(math.sin(heading), math.cos(heading))
                if fold else heading]  # fmt: skip

    return path


winding = pytest.mark.parametrize(("fold", "phase"), [(False, 0.0), (True, 0.0), (True, 1.0), (True, 4.0)])


def make(fold, phase):
    path = heading_along_path(phase)
    return Reference.of(lambda t: path(t, fold), seconds=6.0, lap=3.0)


def turned_by(angle):
    return np.remainder(angle + math.pi, 2.0 * math.pi) - math.pi


def check_heading(reference, first, last):
    """Assert that the heading turns steadily, and that its rate is its derivative except for whole turns."""
    step = 1e-3
    times = np.arange(first, last, step)
    points = at(reference, times)
    turns = turned_by(np.diff(points.heading))
    np.testing.assert_allclose(turns / step, 0.5 * (points.heading_rate[1:] + points.heading_rate[:-1]), atol=0.1)


@winding
def test_rate_of_heading_is_its_derivative(fold, phase):
    reference = make(fold, phase)
    assert np.abs(reference.rows[:, 17]).max() == pytest.approx(2.0 * math.pi / 3.0, rel=1e-3)
    assert np.abs(np.diff(reference.rows[:, 10])).max() < 0.02  # the value may be interpolated
    assert float(reference.rows[-1, 10] - at_one(reference, 3.0).heading) == pytest.approx(2.0 * math.pi, abs=1e-4)
    check_heading(reference, 0.0, 14.0)


@winding
def test_heading_of_family_equals_members(fold, phase):
    check_heading(join_references([make(fold, phase), circle()]), 0.0, 19.9)


# ---- flatness


def attitude_of(reference, t, h=0.02):
    """Return body axes from the velocity of the table only: z along the required thrust, x towards the heading."""
    ahead, behind = at_one(reference, t + h).v, at_one(reference, t - h).v
    thrust = (ahead - behind) / (2.0 * h) + np.array([0.0, 0.0, 9.81])
    z = thrust / np.linalg.norm(thrust)
    heading = float(at_one(reference, t).heading)
    y = np.cross(z, [math.cos(heading), math.sin(heading), 0.0])
    y = y / np.linalg.norm(y)
    return jnp.asarray(np.stack([np.cross(y, z), y, z], axis=1))


def open_loop_flight(reference, t0, seconds, h=0.005):
    """Return a point mass under the command and from the state of the reference, and the expected state."""
    here = at_one(reference, t0)
    x = State(jnp.array(here.p), attitude_of(reference, t0) if t0 > 0.0 else jnp.eye(3), jnp.array(here.v))
    times = t0 + h * np.arange(round(seconds / h))
    _, path = _open_loop(x, jnp.asarray(at(reference, times + 0.5 * h).u), h)
    return np.linalg.norm(path - at(reference, times + h).p, axis=1)


@eqx.filter_jit
def _open_loop(x, commands, h):
    def tick(x, u):
        x = PointMass(h).step(x, Command.of(u), jnp.zeros(3))
        return x, x.p

    return jax.lax.scan(tick, x, commands)


@pytest.mark.parametrize(("name", "t0"), [("circle", 4.0), ("circle", 0.0), ("figure8", 3.5), ("figure8", 4.7)])
def test_command_tracks_reference_open_loop(name, t0, tables):
    assert open_loop_flight(tables[name], t0, 1.0).max() < 5e-3


def test_command_tracks_turning_reference_open_loop():
    """A climbing circle with the heading along the motion."""

    def helix(t):
        return [math.cos(t), math.sin(t), 1.0 + 0.2 * t, t + 0.5 * math.pi]

    reference = Reference.of(helix, seconds=6.0)
    assert open_loop_flight(reference, 2.0, 1.0).max() < 5e-3
    spin = np.asarray(at_one(reference, 3.0).u)
    assert spin[3] == pytest.approx(1.0, abs=0.02)


def test_thrust_of_the_circle_by_hand(tables):
    """(2 pi / 3 s)^2 x 1 m sideways plus gravity."""
    c = at(tables["circle"], np.linspace(3.5, 5.5, 50)).u[:, 0]
    np.testing.assert_allclose(c, math.hypot((2.0 * math.pi / 3.0) ** 2, 9.81), rtol=1e-3)


def test_command_at_velocity_jump_is_hover(tables):
    rows = np.asarray(tables["star"].rows)
    assert np.abs(rows[:, 6] - 9.81).max() < 0.5  # no command flies a corner


# ---- infeasible references


def test_smooth_shapes_of_paper_are_feasible(tables):
    assert tables["circle"].infeasibility(small()) is None
    assert tables["figure8"].infeasibility(small()) is None


def test_velocity_jump_is_reported(tables):
    """Edges meet at 36 degrees: the velocity turns by 144 degrees, 2 x 1.585 m/s x sin 72 = 3.02 m/s."""
    text = tables["star"].infeasibility(small())
    assert "velocity jumps by 3.0" in text
    when = float(text.split(" at ")[1].split(" s")[0])
    corner = at_one(tables["star"], when).p
    assert np.abs(complex(corner[0], corner[1]) - np.array(CORNERS)).min() < 0.03


def test_excessive_thrust_is_reported():
    """With a load above its weight, the small vehicle has 28.6 m/s^2; a circle at 27.4 m/s^2 needs 29.1."""
    heavy = with_payload(small(), 0.3)
    text = circle(radius=1.0, period=1.2).infeasibility(heavy)
    assert "needs 29.1 m/s² of thrust" in text
    assert "the vehicle has 28.6" in text
    assert "thrust" not in circle(radius=1.0, period=1.3).infeasibility(heavy)


def test_thrust_of_far_too_fast_circle_is_reported():
    assert "of thrust" in circle(radius=3.0, period=1.0).infeasibility(small())


def test_axis_of_excessive_rate_is_reported():
    """A heading that turns at 6 rad/s on the spot, and a circle that needs more roll rate than a slow vehicle has."""
    spin = Reference.of(lambda t: [0.0, 0.0, 1.0, 6.0 * t], seconds=2.0)
    text = spin.infeasibility(small())
    assert "it needs 6.0 rad/s about z" in text
    assert "the limit is 4.0" in text
    lazy = replace_fields(small(), omega_max=jnp.array([0.5, 6.0, 4.0]))
    assert "rad/s about x" in circle().infeasibility(lazy)


def test_start_and_end_at_speed_are_reported():
    text = Reference.of(lambda t: [2.0 * t, 0.0, 1.0], seconds=2.0).infeasibility(small())
    assert "it starts at speed, 2.00 m/s" in text
    assert "it ends at speed, 2.00 m/s" in text
    lap = Reference.of(lambda t: [math.sin(t), math.cos(t), 1.0], seconds=2.0 * math.pi, lap=0.0)
    assert "it starts at speed, 1.00 m/s" in lap.infeasibility(small())
    assert "it ends" not in lap.infeasibility(small())


def dive(depth, seconds=1.0):
    """Return a descent by ``depth`` [m] from rest to rest, with a largest acceleration of 2 pi depth / seconds^2."""
    w = 2.0 * math.pi / seconds
    return lambda t: [0.0, 0.0, 9.0 - depth * (w * t - math.sin(w * t)) / (2.0 * math.pi)]


def test_descent_faster_than_free_fall_is_reported():
    """1.5 m in 1 s need 9.42 m/s^2 downwards, and 1.7 m need 10.68 m/s^2."""
    assert Reference.of(dive(1.5), seconds=1.0).infeasibility(small()) is None
    text = Reference.of(dive(1.7), seconds=1.0).infeasibility(small())
    assert "steeper than free fall at 0.2" in text
    assert "(10.7 m/s² downwards)" in text


def test_command_in_free_fall_is_hover():
    """Without thrust the attitude is undefined: the command is finite, and the reason is reported."""
    height = 9.0 - 0.5 * 9.81 * np.linspace(0.0, 1.0, 5) ** 2
    reference = Reference.of(lambda t: [0.0, 0.0, 9.0 - 0.5 * 9.81 * t**2], seconds=1.0)
    assert np.isfinite(np.asarray(reference.rows)).all()
    np.testing.assert_allclose(at(reference, np.linspace(0.0, 0.999, 5)).p[:, 2], height, atol=0.02)
    assert "ends at speed" in reference.infeasibility(small())


def test_ground_contact_is_reported():
    text = Reference.of(lambda t: [0.0, 0.0, 0.5 - 0.9 * smooth_start(t, 2.0)], seconds=2.0).infeasibility(small())
    assert "0.40 m below the ground, z = 0, at 2.00 s" in text


def test_open_lap_is_reported():
    def path(t):
        return [0.1 * smooth_start(t), 0.0, 1.0]

    assert "its lap does not close: its end is 0.20 m" in Reference.of(path, seconds=5.0, lap=3.0).infeasibility(
        small()
    )


def test_velocity_jump_between_laps_is_reported():
    """Back and forth at 1 m/s: the velocity reverses between laps, within a millimetre of the start."""

    def path(t):
        s = smooth_start(t) % 2.0
        return [min(s, 2.0 - s), 0.0, 1.0]

    reference = Reference.of(path, seconds=5.0, lap=3.0)
    assert "velocity jumps by" in reference.infeasibility(small())
    bow = Reference.of(lambda t: [math.sin(0.5 * math.pi * smooth_start(t) % math.pi), 0.0, 1.0], seconds=5.0, lap=3.0)
    assert "velocity jumps by" in bow.infeasibility(small())


def test_all_reasons_are_reported():
    text = Reference.of(lambda t: [2.0 * t, 0.0, -1.0, 9.0 * t], seconds=2.0).infeasibility(small())
    assert text.count(";") == 3
    for reason in ("starts at speed", "ends at speed", "rad/s about z", "below the ground"):
        assert reason in text


# ---- refusals


def test_path_must_be_finite_with_three_or_four_numbers():
    with pytest.raises(ValueError, match=r"at 1\.\d+ s the path gives .*nan"):
        Reference.of(lambda t: [math.nan if t > 1.0 else 0.0, 0.0, 1.0], seconds=2.0)
    with pytest.raises(ValueError, match=r"the path gives \[.*inf"):
        Reference.of(lambda t: [math.inf, 0.0, 1.0], seconds=2.0)
    for wrong in ([0.0, 1.0], [0.0] * 5, [[0.0, 0.0, 1.0]]):
        with pytest.raises(ValueError, match="not 3 or 4 finite numbers"):
            Reference.of(lambda t, wrong=wrong: wrong, seconds=2.0)


@pytest.mark.parametrize(
    "sizes", [{"seconds": 0.0}, {"lap": 2.0}, {"lap": -0.1}, {"lap": 2.5}, {"points": 1}, {"seconds": math.nan}]
)
def test_invalid_sizes_are_refused(sizes):
    name, value = next(iter(sizes.items()))
    with pytest.raises(ValueError, match=f"Reference: {name} must be .*got {value}"):
        Reference.of(line, **({"seconds": 2.0} | sizes))


def test_number_of_rows():
    assert Reference.of(line, seconds=1.0).rows.shape == (POINTS, 18)
    assert Reference.of(line, seconds=1.0, points=7).rows.shape == (7, 18)


# ---- without a lap


def test_end_is_held():
    reference = Reference.of(lambda t: [math.sin(0.5 * math.pi * t), 0.0, 1.0], seconds=1.0)
    end = at_one(reference, 1.0)
    for t in (1.001, 5.0, 1e4):
        later = at_one(reference, t)
        for a, b in zip(end, later, strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(end.p, [1.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(end.v, 0.0, atol=0.01)


# ---- families


@pytest.mark.parametrize("what", ["joined", "distance"])
def test_no_silent_type_promotion(what, tables):
    if what == "joined":
        join_references([tables["circle"]], seconds=6.0)
    else:
        tables["circle"].distance(jnp.zeros(3))


def test_each_part_of_family_is_its_reference(tables):
    family = join_references(list(tables.values()))
    times = 0.02 * np.arange(950)
    for k, reference in enumerate(tables.values()):
        result, expected = at(family, 20.0 * k + times), at(reference, times)
        for a, b in zip(result, expected, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9)
    between = at(family, times + 0.01).p - at(tables["circle"], times + 0.01).p
    assert np.abs(between).max() < 1e-3


def test_roll_outs_stay_in_one_part_of_family(tables):
    """From every possible start, 4 s of roll-out and 0.5 s of preview stay in the part."""
    family = join_references(list(tables.values()), seconds=8.0, every=0.02)
    for k, (first, last) in enumerate(np.asarray(family.joins)):
        assert 8.0 * k <= first < last
        assert last + 4.0 + 0.5 < 8.0 * (k + 1) - 0.02
    assert family.joins.shape == (len(tables), 2)


def test_family_needs_members_and_time(tables):
    for members, seconds in (([], 20.0), (list(tables.values()), 5.9)):
        with pytest.raises(ValueError, match="at least 1, of at least 6 s"):
            join_references(members, seconds=seconds)


# ---- cross-track


distances = eqx.filter_jit(lambda reference, p: jax.vmap(reference.distance)(p))


@names
def test_cross_track_error_is_zero_on_lap(name, tables):
    reference = tables[name]
    rows, times = np.asarray(reference.rows), row_times(reference)
    on = rows[times >= RAMP][::37, :3]
    np.testing.assert_allclose(distances(reference, jnp.asarray(on)), 0.0, atol=1e-12)
    between = at(reference, RAMP + PERIODS[name] * np.linspace(0.0, 1.0, 333)).p
    assert float(distances(reference, between).max()) < 1e-9


def test_cross_track_error_of_circle_is_radial_offset(tables, key):
    angle, offset = random.uniform(key, (2, 20))
    for a, d in zip(6.28 * np.asarray(angle), 0.9 * np.asarray(offset) + 0.05, strict=True):
        for way in (1.0 + d, 1.0 - 0.9 * d):
            p = jnp.array([1.0 + way * math.cos(a), way * math.sin(a), 1.0])
            assert float(tables["circle"].distance(p)) == pytest.approx(abs(way - 1.0), abs=2e-5)
    above = jnp.array([2.0, 0.0, 1.7])
    assert float(tables["circle"].distance(above)) == pytest.approx(0.7, abs=2e-5)


def test_cross_track_error_uses_lap_only(tables):
    """The path to the lap does not count; without a lap the whole path does."""

    def path(t):
        return [0.0, 0.0, t] if t < 1.0 else [math.sin(2.0 * math.pi * t), 0.0, 1.0]

    start = jnp.zeros(3)
    assert float(Reference.of(path, seconds=2.0, lap=1.0).distance(start)) == pytest.approx(1.0, abs=1e-2)
    assert float(Reference.of(path, seconds=2.0).distance(start)) == pytest.approx(0.0, abs=1e-2)


@pytest.mark.parametrize("make", [circle, figure8, star])
def test_size_and_period_can_be_chosen(make):
    reference = make(period=4.0, ramp=2.0)
    np.testing.assert_array_equal(reference.lap, [2.0, 6.0])
    np.testing.assert_allclose(at_one(reference, 2.5).p, at_one(reference, 6.5).p, atol=1e-8)


# ---- with a top speed


def test_slow_lissajous_takes_ten_seconds():
    reference = AT_SPEED["lissajous"](0.8886)
    start, end = np.asarray(reference.lap)
    assert end - start == pytest.approx(10.0, abs=2e-3)
    assert np.ptp(np.asarray(reference.rows)[:, 0]) == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize("speed", [1.5, 4.0, 8.0])
@pytest.mark.parametrize("shape", AT_SPEED)
def test_shape_with_top_speed(shape, speed):
    """The lap has this speed and never exceeds it, and a vehicle with 2 g can fly it except for the corners of the
    star.
    """
    reference = AT_SPEED[shape](speed)
    rows, lap = np.asarray(reference.rows), np.asarray(reference.lap)
    speeds = np.linalg.norm(rows[:, 3:6], axis=1)
    assert speeds[row_times(reference) >= lap[0]].max() == pytest.approx(speed, rel=0.01)
    assert speeds.max() < 1.01 * speed
    assert rows[:, 6].max() < np.hypot(9.81, 12.0) + 0.1
    assert reference.infeasibility(kingfisher()) is None or shape == "star"
