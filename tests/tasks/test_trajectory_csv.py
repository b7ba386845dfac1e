"""Trajectory files: accepted forms, repetition, and refusals with their reasons."""

import itertools
import math

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from helpers import at
from retrim.errors import ConfigError
from retrim.physics import small
from retrim.tasks import from_csv, smooth_start
from retrim.tasks.shapes import circle, figure8, star
from retrim.tasks.trajectory_table import read_table

TURN = 2.0 * math.pi


def write(tmp_path, text):
    file = tmp_path / "path.csv"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    return file


def sample_to_file(tmp_path, path, times, *, decimals=6, header="t,x,y,z,yaw"):
    rows = [[t, *path(float(t))] for t in times]
    names = ",".join(header.split(",")[: len(rows[0])])
    lines = [",".join(f"{value:.{decimals}f}" for value in row) for row in rows]
    return write(tmp_path, "\n".join([names, *lines]) + "\n")


def circle_lap(t):
    """Return the circle of the paper from its first lap on, without the start from rest."""
    phi = TURN * t / 3.0
    return [1.0 - math.cos(phi), -math.sin(phi), 1.0]


def eight_lap(t):
    phi = TURN * t / 5.0
    return [1.5 - 1.5 * math.cos(phi), -0.5 * math.sin(2.0 * phi), 1.0]


# ---- laps


@pytest.mark.parametrize(("lap", "shape", "period"), [(circle_lap, circle, 3.0), (eight_lap, figure8, 5.0)])
def test_sampled_lap_equals_built_in_shape(lap, shape, period, tmp_path):
    """Positions agree within 1 mm, including the smooth start and the tenth lap, and the reference is feasible."""
    reference = from_csv(sample_to_file(tmp_path, lap, np.linspace(0.0, period, round(50 * period) + 1)))
    np.testing.assert_array_equal(reference.lap, shape().lap)
    times = np.concatenate([np.linspace(0.0, 3.0 + 2.0 * period, 501), 3.0 + 9.0 * period + np.linspace(0, 3, 50)])
    result, expected = at(reference, times), at(shape(), times)
    np.testing.assert_allclose(result.p, expected.p, atol=1e-3)
    np.testing.assert_allclose(result.v, expected.v, atol=5e-3)
    np.testing.assert_allclose(result.u, expected.u, atol=0.2)
    assert reference.infeasibility(small()) is None
    rates = np.abs(np.asarray(reference.rows)[:, 7:10]).max(axis=0)
    assert (rates < 0.8 * np.asarray(small().omega_max)).all()


def test_lap_of_few_points_is_smooth_between_laps(tmp_path):
    reference = from_csv(sample_to_file(tmp_path, circle_lap, np.linspace(0.0, 3.0, 9)))
    radius = np.linalg.norm(np.asarray(reference.rows)[:, :2] - np.array([1.0, 0.0]), axis=1)
    np.testing.assert_allclose(radius, 1.0, atol=0.01)
    seam = at(reference, [6.0 - 1e-3, 6.0 + 1e-3])
    np.testing.assert_allclose(seam.v[0], seam.v[1], atol=0.02)
    assert reference.infeasibility(small()) is None


@pytest.mark.parametrize("gap", [0.0, 0.005, 0.0099])
def test_small_gap_between_ends_is_closed_smoothly(gap, tmp_path):
    """The gap is distributed over the lap, and not closed in one step between two points."""
    file = sample_to_file(
        tmp_path, lambda t: [circle_lap(t)[0] + gap * t / 3.0, *circle_lap(t)[1:]], np.linspace(0, 3, 151)
    )
    reference = from_csv(file)
    assert float(reference.lap[1] - reference.lap[0]) == 3.0
    assert reference.infeasibility(small()) is None
    rows = np.asarray(reference.rows)
    np.testing.assert_allclose(np.linalg.norm(rows[:, :2] - np.array([1.0, 0.0]), axis=1), 1.0, atol=1.01 * gap + 1e-4)


def test_gap_of_two_centimetres_is_not_closed(tmp_path):
    file = sample_to_file(
        tmp_path, lambda t: [circle_lap(t)[0] + 0.02 * t / 3.0, *circle_lap(t)[1:]], np.linspace(0, 3, 151)
    )
    reference = from_csv(file)
    assert float(reference.lap[0]) == float(reference.lap[1]) == 3.0
    with pytest.raises(ConfigError, match=r"path.csv: its last point is 0\.020 m from its first.*a lap ends with"):
        from_csv(file, laps=True)


def test_closed_file_can_be_flown_once(tmp_path):
    file = sample_to_file(tmp_path, circle_lap, np.linspace(0.0, 3.0, 151))
    reference = from_csv(file, laps=False)
    np.testing.assert_array_equal(reference.lap, [3.0, 3.0])
    np.testing.assert_allclose(at(reference, [1.0]).p[0], circle_lap(1.0), atol=1e-5)
    text = reference.infeasibility(small())
    assert "starts at speed, 2.09 m/s" in text
    assert "ends at speed, 2.09 m/s" in text
    assert "rad/s" not in text  # no false peak at the ends


def test_lap_from_rest_to_rest_keeps_its_times(tmp_path):
    """Back and forth in 4 s, at rest at both ends: no part is slowed down."""

    def path(t):
        return [0.5 - 0.5 * math.cos(TURN * t / 4.0), 0.0, 1.0]

    reference = from_csv(sample_to_file(tmp_path, path, np.linspace(0.0, 4.0, 101)))
    np.testing.assert_array_equal(reference.lap, [0.0, 4.0])
    times = np.linspace(0.0, 12.0, 100)
    np.testing.assert_allclose(at(reference, times).p, [path(t) for t in times], atol=1e-3)
    assert reference.infeasibility(small()) is None


def test_heading_is_continuous_between_laps(tmp_path):
    """The heading follows the motion and is wrapped in the file: it gains a turn per lap, without a peak."""

    def path(t):
        return [*circle_lap(t), math.remainder(-0.5 * math.pi + TURN * t / 3.0, TURN)]

    reference = from_csv(sample_to_file(tmp_path, path, np.linspace(0.0, 3.0, 151)))
    np.testing.assert_array_equal(reference.lap, [3.0, 6.0])
    times = np.linspace(3.1, 11.9, 200)
    points = at(reference, times)
    expected = -0.5 * math.pi + TURN * (times - 1.5) / 3.0
    np.testing.assert_allclose(np.cos(points.heading - expected), 1.0, atol=1e-6)
    steady = np.asarray(points.u)[:, 1:]  # 2 pi / 3 s about the vertical, in the tilted body frame
    np.testing.assert_allclose(np.linalg.norm(steady, axis=1), TURN / 3.0, atol=0.1)
    assert reference.infeasibility(small()) is None


def test_different_yaw_at_end_is_not_a_lap(tmp_path):
    file = sample_to_file(tmp_path, lambda t: [*circle_lap(t), 0.5 * t], np.linspace(0.0, 3.0, 151))
    assert float(from_csv(file).lap[0]) == 3.0
    with pytest.raises(ConfigError, match="where its first is, but with another yaw"):
        from_csv(file, laps=True)


def test_two_or_three_points_are_not_a_lap(tmp_path):
    file = write(tmp_path, "0,0,0,1\n2,1,0,1\n4,0,0,1\n")
    np.testing.assert_array_equal(from_csv(file).lap, [4.0, 4.0])
    with pytest.raises(ConfigError, match="3 points; a lap needs at least four"):
        from_csv(file, laps=True)


def with_smooth_start(lap):
    """Return a lap with its own smooth start, as in published tables of such shapes."""
    return lambda t: lap(smooth_start(t))


@pytest.mark.parametrize(("lap", "period", "end"), [(circle_lap, 3.0, 9.32), (eight_lap, 5.0, 10.98)])
def test_file_that_ends_within_lap_repeats_last_lap(lap, period, end, tmp_path):
    """The file has a start from rest and some laps: the last lap repeats, and the start is unchanged."""
    path = with_smooth_start(lap)
    reference = from_csv(sample_to_file(tmp_path, path, np.arange(0.0, end, 0.02), decimals=9))
    assert float(reference.lap[1] - reference.lap[0]) == pytest.approx(period, abs=1e-3)
    times = np.linspace(0.0, 30.0, 700)
    np.testing.assert_allclose(at(reference, times).p, [path(t) for t in times], atol=5e-3)
    assert reference.infeasibility(small()) is None


def test_file_within_lap_gets_smooth_start(tmp_path):
    """For 1.5 laps, a smooth start is added, and a lap has the length of one lap."""
    reference = from_csv(sample_to_file(tmp_path, circle_lap, np.linspace(0.0, 4.5, 226)))
    assert float(reference.lap[1] - reference.lap[0]) == pytest.approx(3.0, abs=1e-3)
    times = np.linspace(0.0, 20.0, 300)
    np.testing.assert_allclose(at(reference, times).p, at(circle(), times).p, atol=5e-3)
    assert reference.infeasibility(small()) is None


def test_crossing_is_not_a_lap(tmp_path):
    """The figure-8 ends at an earlier position in a different direction."""
    reference = from_csv(sample_to_file(tmp_path, eight_lap, np.arange(0.0, 3.7501, 0.02)[1:]))
    assert float(reference.lap[0]) == float(reference.lap[1])


def test_hover_at_end_is_not_a_lap(tmp_path):
    def path(t):
        x = min(0.5 * t, 1.0)
        return [10.0 * x**3 - 15.0 * x**4 + 6.0 * x**5, 0.0, 1.0]

    reference = from_csv(sample_to_file(tmp_path, path, np.arange(0.0, 4.0, 0.02)))
    assert float(reference.lap[0]) == float(reference.lap[1])
    assert reference.infeasibility(small()) is None


def test_start_at_rest_and_end_at_speed_are_not_a_lap(tmp_path):
    file = sample_to_file(tmp_path, with_smooth_start(circle_lap), np.linspace(0.0, 4.5, 226))
    reference = from_csv(file)
    assert "ends at speed, 2.09 m/s" in reference.infeasibility(small())
    with pytest.raises(ConfigError, match="it rests at one of its ends and moves at the other"):
        from_csv(file, laps=True)


def test_corners_of_sampled_star_are_reported(tmp_path):
    times = np.linspace(3.0, 9.0, 301)
    rows = np.column_stack([times, at(star(), times).p])
    reference = from_csv(write(tmp_path, "\n".join(",".join(map(str, row)) for row in rows)))
    assert float(reference.lap[1] - reference.lap[0]) == pytest.approx(6.0)
    assert "velocity jumps" in reference.infeasibility(small())


def test_long_files_keep_row_spacing(tmp_path):
    times = np.linspace(0.0, 45.0, 451)
    reference = from_csv(sample_to_file(tmp_path, lambda t: [math.sin(TURN * t / 3.0), 0.0, 1.0], times))
    assert float(reference.every) <= 0.02
    assert reference.rows.shape[0] % 1024 == 0


# ---- once


def helix(s):
    return [math.cos(s), math.sin(s), 0.2 * s, 0.5 * s]


def test_once_passes_points_from_rest_to_rest(tmp_path):
    """Way-points are passed at their times, at rest at both ends, and the last one is held."""
    points = np.array([[0.0, 0.0, 0.0, 1.0], [1.5, 1.0, 0.0, 1.2], [3.0, 1.0, 1.0, 1.5], [5.0, 0.0, 2.0, 1.0]])
    text = "\n".join(",".join(map(str, row)) for row in points)
    reference = from_csv(write(tmp_path, text))
    result = at(reference, points[:, 0])
    np.testing.assert_allclose(result.p, points[:, 1:], atol=1e-4)
    np.testing.assert_allclose(result.v[jnp.array([0, 3])], 0.0, atol=0.02)
    hold = at(reference, [5.01, 100.0])
    np.testing.assert_allclose(hold.p, [points[-1, 1:]] * 2, atol=1e-9)
    np.testing.assert_array_equal(hold.v, 0.0)
    np.testing.assert_allclose(hold.u, [[9.81, 0.0, 0.0, 0.0]] * 2)
    np.testing.assert_array_equal(reference.rows[:, 10], 0.0)  # the heading is along x
    assert reference.infeasibility(small()) is None


def test_once_follows_curve_between_points(tmp_path):
    reference = from_csv(sample_to_file(tmp_path, helix, np.linspace(2.0, 8.0, 121)))
    times = np.linspace(0.0, 5.99, 77)
    result = at(reference, times)
    np.testing.assert_allclose(result.p, [helix(t + 2.0)[:3] for t in times], atol=1e-4)
    np.testing.assert_allclose(result.heading, 0.5 * (times + 2.0), atol=1e-4)
    np.testing.assert_allclose(result.v, [[-math.sin(t + 2), math.cos(t + 2), 0.2] for t in times], atol=5e-3)
    text = reference.infeasibility(small())
    assert text == (
        "it starts at speed, 1.02 m/s, and a flight starts at rest; "
        "it ends at speed, 1.02 m/s, where its last point is held"
    )


def largest_excursion(points, reference):
    """Return the largest distance [m] of a reference from the box of the two points before and after each time."""
    rows, times = np.asarray(reference.rows, float), points[:, 0] - points[0, 0]
    now = np.arange(len(rows)) * float(reference.every)
    k = np.clip(np.searchsorted(times, now, side="right") - 1, 0, len(times) - 2)
    near = points[np.clip(k[:, None] + np.arange(-1, 3), 0, len(times) - 1), 1:4]
    return float(np.maximum(rows[:, :3] - near.max(axis=1), near.min(axis=1) - rows[:, :3]).max())


def path_file(tmp_path, points):
    return write(tmp_path, "\n".join(",".join(f"{value:.6f}" for value in row) for row in points))


def wave(s):
    return np.column_stack([0.5 - 0.5 * np.cos(0.9 * s), 0.3 * np.sin(s), 1.0 + 0.2 * np.sin(0.7 * s)])


@pytest.mark.parametrize("where", [0, 20, 59, 118])
@pytest.mark.parametrize("length", [1.0, 30.0, 500.0])
def test_wait_stays_in_its_place(length, where, tmp_path):
    """Two equal points, long after each other between points every 0.1 s, are a wait at rest."""
    s = 0.1 * np.arange(120)
    points = np.column_stack([s, wave(s)])
    points[where + 1 :, 1:] = np.concatenate([points[where : where + 1, 1:], points[where + 1 : -1, 1:]])
    points[where + 1 :, 0] += length
    reference = from_csv(path_file(tmp_path, points), laps=False)
    assert largest_excursion(points, reference) < 0.02
    begin, end = points[where : where + 2, 0]
    wait = at(reference, np.linspace(begin + 0.4 * (end - begin), begin + 0.6 * (end - begin), 9))
    np.testing.assert_allclose(wait.p, np.repeat(points[where : where + 1, 1:4], 9, axis=0), atol=2e-3)
    np.testing.assert_allclose(wait.v, 0.0, atol=0.02)


def test_wait_is_entered_with_continuous_acceleration(tmp_path):
    """From row to row, the acceleration changes by little: there is no corner, and no jump of the thrust."""
    s = 0.5 * np.arange(24)
    points = np.column_stack([s + 20.0 * (s > 6.0), wave(np.where(s > 6.0, s - 0.5, s))])
    rows = np.asarray(from_csv(path_file(tmp_path, points), laps=False).rows, float)
    v = rows[:, 3:6]
    accelerations = np.diff(v, axis=0) / (points[-1, 0] / (len(rows) - 1))
    assert np.abs(np.diff(accelerations, axis=0)).max() < 0.5


@pytest.mark.parametrize("seed", range(10))
def test_uneven_times_keep_path_near_its_points(seed, tmp_path):
    """Intervals of a smooth path from 0.03 s to 10 s, in random order, with waits among them."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([np.cumsum(10.0 ** rng.uniform(-1.5, 1.0, 60)), wave(0.1 * np.arange(60))])
    points[30, 1:] = points[29, 1:]
    assert largest_excursion(points, from_csv(path_file(tmp_path, points))) < 0.06


def test_missing_points_of_motion_are_not_a_wait(tmp_path):
    """A tenth of a recorded circle is missing: the spline joins its ends along the circle."""
    times = np.linspace(0.0, 3.0, 151)
    times = times[(times < 1.01) | (times > 1.31)]
    rows = np.asarray(from_csv(sample_to_file(tmp_path, circle_lap, times)).rows, float)
    np.testing.assert_allclose(np.linalg.norm(rows[:, :2] - [1.0, 0.0], axis=1), 1.0, atol=2e-3)


def test_lap_with_wait_waits_in_every_lap(tmp_path):
    times = np.linspace(0.0, 3.0, 61)
    points = np.column_stack([times, [circle_lap(t) for t in times]])
    points = np.insert(points, 31, points[30], axis=0)
    points[31:, 0] += 20.0
    reference = from_csv(path_file(tmp_path, points))
    assert float(reference.lap[1] - reference.lap[0]) == pytest.approx(23.0)
    wait = at(reference, [10.0, 33.0, 56.0]).p
    np.testing.assert_allclose(wait, np.repeat(points[30:31, 1:4], 3, axis=0), atol=1e-3)
    radius = np.linalg.norm(np.asarray(reference.rows)[:, :2] - [1.0, 0.0], axis=1)
    np.testing.assert_allclose(radius, 1.0, atol=0.02)


# ---- accepted forms

ROWS = np.array([[0.0, 0.0, 0.0, 1.0, 0.1], [1.0, 1.0, 0.5, 2.0, 0.2], [2.5, 2.0, 0.0, 3.0, 0.3]])


def text_of(columns, sign=",", header=True, end=""):
    order = [("t", "x", "y", "z", "yaw").index(name) for name in columns]
    lines = [sign.join(columns)] * header + [sign.join(f"{row[k]:g}" for k in order) for row in ROWS]
    return "".join(line + end + "\n" for line in lines)


@pytest.mark.parametrize("columns", list(itertools.permutations(("t", "x", "y", "z", "yaw")))[::7])
def test_columns_by_name_in_any_order(columns, tmp_path):
    np.testing.assert_array_equal(read_table(write(tmp_path, text_of(columns))), ROWS)


@pytest.mark.parametrize("sign", [",", ";", "\t", " ", ", ", " ; ", "   ", " \t"])
@pytest.mark.parametrize("header", [True, False])
def test_separators(sign, header, tmp_path):
    text = text_of(("t", "x", "y", "z", "yaw"), sign, header)
    np.testing.assert_array_equal(read_table(write(tmp_path, text)), ROWS)


@pytest.mark.parametrize(
    "header",
    [
        "T, X, Y, Z, Yaw",
        "time, x, y, z, heading",
        "Timestamp [s], x [m], y (m), z[m], psi [rad]",
        '"t","x","y","z","yaw"',
        "# t, x, y, z, yaw",
        "# a flight of 2026\n\n#t,x,y,z,yaw  ",
        "\ufefft,x,y,z,yaw",
        "\ufeff",
        "# no header",
        "# positions of the vehicle, in metres",
    ],
)
def test_headers(header, tmp_path):
    text = header + "\n" + text_of(("t", "x", "y", "z", "yaw"), header=False)
    np.testing.assert_array_equal(read_table(write(tmp_path, text)), ROWS)


@pytest.mark.parametrize(
    "names",
    [
        "t,p_x,p_y,p_z",
        "time,pos_x,pos_y,pos_z",
        "timestamp,position.x,position.y,position.z",
        "t,px,py,pz",
        "t,x,y,z,vx,vy,vz",
        "t,p_x,p_y,p_z,q_w,q_x,q_y,q_z,v_x,v_y,v_z,w_x,w_y,w_z,a_lin_x,a_lin_y,a_lin_z,a_rot_x,u_1,u_2,u_3,u_4,jerk_x",
        "t,x,y,z,_gate,_note",
    ],
)
def test_other_column_names_and_derived_columns(names, tmp_path):
    """The first is that of rpg_time_optimal and gym-pybullet-drones; unused columns may contain anything."""
    more = ",oops" * (names.count(",") - 3)
    text = names + "\n" + "".join(",".join(f"{x:g}" for x in row[:4]) + more + "\n" for row in ROWS)
    np.testing.assert_array_equal(read_table(write(tmp_path, text))[:, :4], ROWS[:, :4])


@pytest.mark.parametrize("later", [0.0, 5e-7, -5e-7])
def test_shared_point_of_segments_is_used_once(later, tmp_path):
    again = np.insert(ROWS, 2, ROWS[1] + [later, 0.0, 0.0, 0.0, 0.0], axis=0)
    text = "\n".join(",".join(f"{x:.9f}" for x in row) for row in again)
    np.testing.assert_array_equal(read_table(write(tmp_path, text)), ROWS)


def test_two_positions_at_one_time_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="line 3: time 1 s does not come after 1 s"):
        read_table(write(tmp_path, "0,0,0,1\n1,0,0,1\n1,0.1,0,1\n"))


def test_commented_header_sets_column_order(tmp_path):
    """NumPy writes its headers as comments."""
    order = ("t", "y", "x", "z")
    file = tmp_path / "path.csv"
    np.savetxt(file, ROWS[:, [0, 2, 1, 3]], header=" ".join(order))
    np.testing.assert_allclose(read_table(file)[:, :4], ROWS[:, :4])


def test_comments_blanks_quotes_and_trailing_separators(tmp_path):
    text = '# by hand\nt,x,y,z,\n\n0,0,0,1,  # here\n  \n"1","1","0.5",2,,\r\n2.5,2,0,3\n,,,\n'
    with pytest.raises(ConfigError, match="line 8"):
        read_table(write(tmp_path, text))
    result = read_table(write(tmp_path, text.removesuffix(",,,\n")))
    np.testing.assert_array_equal(result[:, :4], ROWS[:, :4])
    np.testing.assert_array_equal(result[:, 4], 0.0)


def test_times_count_from_first_point(tmp_path):
    text = "\n".join(f"{t + 170.0},{t},0,1" for t in range(5))
    np.testing.assert_array_equal(read_table(write(tmp_path, text))[:, 0], range(5))


def test_wrapped_yaw_is_unwrapped(tmp_path):
    expected = np.linspace(0.5, 11.0, 50)
    text = "\n".join(f"{0.1 * k},0,0,1,{math.remainder(yaw, TURN)}" for k, yaw in enumerate(expected))
    np.testing.assert_allclose(read_table(write(tmp_path, text))[:, 4], expected, atol=1e-9)


numbers = st.floats(-900.0, 900.0).map(lambda v: round(v, 6))


@given(
    rows=st.lists(st.tuples(numbers, numbers, numbers, st.floats(-3.1, 3.1)), min_size=2, max_size=8),
    columns=st.permutations(["t", "x", "y", "z", "yaw"]),
    sign=st.sampled_from([",", ";", "\t", " "]),
)
@settings(max_examples=50, deadline=None)
def test_written_points_are_read(rows, columns, sign, tmp_path_factory):
    """Points are plausible, in any order of columns, with any separator, and yaw is equal except for whole turns."""
    # otherwise the times could be in ms
    assume(max(math.dist(a[:3], b[:3]) for a, b in itertools.pairwise(rows)) >= 25.0)
    points = [dict(zip(("x", "y", "z", "yaw"), row, strict=True), t=25.0 * k) for k, row in enumerate(rows)]
    text = "\n".join([sign.join(columns), *(sign.join(repr(float(p[name])) for name in columns) for p in points)])
    table = read_table(write(tmp_path_factory.mktemp("points"), text))
    np.testing.assert_array_equal(table[:, 0], [p["t"] for p in points])
    np.testing.assert_array_equal(table[:, 1:4], [row[:3] for row in rows])
    np.testing.assert_allclose(np.exp(1j * table[:, 4]), np.exp(1j * np.array([row[3] for row in rows])), atol=1e-9)


@given(content=st.binary(max_size=60) | st.text("0123456789.,;\t #\"'txyzaw[]()-+enif\n", max_size=80))
@settings(max_examples=200, deadline=None)
def test_any_text_gives_points_or_one_error(content, tmp_path_factory):
    """Any file gives finite points at increasing times, or one clear error."""
    file = write(tmp_path_factory.getbasetemp(), content)
    try:
        table = read_table(file)
    except ConfigError:
        with pytest.raises(ConfigError, match=r"path\.csv"):
            from_csv(file)
    else:
        assert np.isfinite(table).all()
        assert table[0, 0] == 0.0
        assert (np.diff(table[:, 0]) > 0.0).all()


# ---- refusals

EXPECTED = r"t \[s\], x, y, z \[m\] and, if desired, yaw \[rad\]"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        # header
        ("t,x,y,z,gate\n0,0,0,1,0\n", rf"line 1: column 'gate' is not known; {EXPECTED}.* begins with _ is not read"),
        ("# t x y z q\n0 0 0 1 0\n", "line 1: column 'q' is not known"),
        ("t,x,y\n0,0,0\n", rf"line 1: no column z; {EXPECTED}"),
        ("x,y\n0,0\n", "line 1: no column t, z"),
        ("t,time,x,y,z\n0,0,0,0,1\n", "line 1: column 't' appears twice"),
        ("t [ms],x,y,z\n0,0,0,1\n", r"line 1: column 't \[ms\]': t is expected in s, not in ms"),
        ("t,x [cm],y,z\n0,0,0,1\n", "x is expected in m, not in cm"),
        ("t,x,y,z,yaw (deg)\n0,0,0,1,0\n", "yaw is expected in rad, not in deg"),
        # numbers
        ("t,x,y,z\n0,0,0,1\n1,one,0,1\n", rf"line 3: x = 'one' in '1, one, 0, 1' is not a number; {EXPECTED}"),
        ("0,0,0,1\nt,x,y,z\n", "line 2: t = 't' in"),
        ("0;0,5;0;1\n", "line 1: x = '0,5' in"),
        ("0,0,0,1\n1,0,,1\n", "line 2: y = '' in"),
        ("0,0,0,1\n1,nan,0,1\n", "line 2: x = 'nan' .* is not finite"),
        ("0,0,0,1\ninf,0,0,1\n", "line 2: t = 'inf' .* is not finite"),
        ("0,0,0,1\n1,0,1e999,1\n", "line 2: y = '1e999' .* is not finite"),
        # columns
        ("0,0,0\n1,0,0\n", rf"line 1: '0, 0, 0' has 3 columns; t, x, y, z are expected: {EXPECTED}"),
        ("0,0,0,1,0,0\n", "line 1: '0, 0, 0, 1, 0, 0' has 6 columns"),
        ("0,0,0,1\n1,0,0,1,0\n", "line 2: '1,0,0,1,0' has 5 columns, the first point 4"),
        ("t,x,y,z,yaw\n0,0,0,1\n", "line 2: '0, 0, 0, 1' has 4 columns; t, x, y, z, yaw are expected"),
        # times
        ("0,0,0,1\n\n1,0,0,1\n1,0,0,2\n", "line 4: time 1 s does not come after 1 s"),
        ("0,0,0,1\n2,0,0,1\n1,0,0,2\n", "line 3: time 1 s does not come after 2 s"),
        # values
        ("0,0,0,1\n1,1200,0,1\n", "line 2: x = 1200 m is beyond 1000 m; are the positions in m"),
        ("0,0,0,1\n1,0,0,1e300\n", r"line 2: z = 1e\+300 m is beyond 1000 m"),
        ("0,0,0,1,0\n1,0,0,1,90\n", "line 2: yaw = 90 looks like degrees; radians between -2 pi and 2 pi"),
        ("# start\n0,0,0,1\n0.02,3,0,1\n", "line 3: 3 m in 0.02 s after the previous point, 150 m/s; are the"),
        # points
        ("t,x,y,z\n0,0,0,1\n", "1 points; a trajectory needs at least two"),
        ("", "0 points"),
        ("# nothing\n\n", "0 points"),
        (b"\xff\xfe0\x00,\x000\x00", "is not UTF-8 text"),
    ],
)
def test_faults_of_file_are_reported_with_line(text, message, tmp_path):
    with pytest.raises(ConfigError, match=message) as error:
        from_csv(write(tmp_path, text))
    assert "path.csv" in str(error.value)


def test_times_in_milliseconds_are_recognised(tmp_path):
    """A lap at 50 Hz lasts 3000 "s"; a short part of it is too slow to be plausible; way-points in s are accepted."""
    for n in (151, 20):
        rows = [[20.0 * k, *circle_lap(0.02 * k)] for k in range(n)]
        with pytest.raises(ConfigError, match=r"are the times in ms\?"):
            read_table(write(tmp_path, "\n".join(",".join(map(str, row)) for row in rows)))
    with pytest.raises(ConfigError, match=r"lasts 700 s; at most 600 s can be flown$"):
        read_table(write(tmp_path, "\n".join(f"{0.5 * k},{0.1 * k},0,1" for k in range(1401))))
    read_table(write(tmp_path, "\n".join(f"{20 * k},{k},0,1" for k in range(20))))
    read_table(write(tmp_path, "\n".join(f"{20 * k},0,0,1" for k in range(20))))  # a hover


def test_points_below_ground_are_accepted_and_reported(tmp_path):
    reference = from_csv(write(tmp_path, "0,0,0,1\n3,0,0,-0.5\n6,0,0,1\n9,0,0,2\n"))
    assert "m below the ground" in reference.infeasibility(small())
