"""The guard's limits, and its fallback controller without learning: it holds a position, sinks, and stops."""

import numpy as np
import pytest

from live_processes import move, rotation
from retrim.onboard.guard import HOVER, UP, Fallback, G, GeometricHover, Limits, Mode, turn
from retrim.physics.state import STANDARD_GRAVITY, Command

DT = 0.02
LOW, HIGH = np.array([0.0, -6.0, -6.0, -2.0]), np.array([30.0, 6.0, 6.0, 2.0])
LIMITS = Limits(np.array([-3.0, -3.0, -0.3]), np.array([3.0, 3.0, 4.0]), LOW, HIGH)


def state(p=(0.0, 0.0, 1.0), turn=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0)):
    return np.concatenate([p, rotation(np.array(turn)).ravel(), v])


def fly_once(x, decide, push, ticks):
    """Fly with a command delay of one tick; return all states."""
    result, acting = [x], np.array([G, 0.0, 0.0, 0.0])
    for _ in range(ticks):
        u, after = decide(result[-1], acting), move(result[-1], acting, push)
        acting = u
        result.append(after)
    return np.stack(result)


@pytest.mark.parametrize(
    ("x", "text"),
    [
        (state((3.1, 0.0, 1.0)), "geofence: at"),
        (state((0.0, 0.0, -0.4)), "geofence: at"),
        (state(turn=(1.5, 0.0, 0.0)), "tilt: 1.50 rad, allowed 1.4"),
        (state(v=(0.0, 16.0, 0.0)), "speed: 16.0 m/s, allowed 15"),
        (state(v=(0.0, np.nan, 0.0)), "the state is not finite"),
    ],
)
def test_each_limit_is_reported(x, text):
    assert text in LIMITS.find_violation(x)


def test_gravity_equals_that_of_models():
    assert G == STANDARD_GRAVITY
    np.testing.assert_array_equal(HOVER, Command.hover().vector())


def test_flight_within_limits_exceeds_none():
    assert LIMITS.find_violation(state((2.9, -2.9, 0.0), (1.3, 0.0, 0.0), (0.0, 14.0, 0.0))) is None


def test_rotation_to_thrust_direction_is_minimal():
    rng = np.random.default_rng(0)
    for _ in range(50):
        R, along = rotation(rng.normal(size=3)), rng.normal(size=3)
        along /= np.linalg.norm(along)
        vector = turn(R, along)
        np.testing.assert_allclose((R @ rotation(vector))[:, 2], along, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(vector), np.arccos(np.clip(R[:, 2] @ along, -1, 1)), atol=1e-7)
    assert np.linalg.norm(turn(rotation(np.array([np.pi, 0.0, 0.0])), UP)) == pytest.approx(np.pi, abs=1e-6)


@pytest.mark.parametrize("push", [(0.0, 0.0, 0.0), (2.0, -2.0, 2.0), (-2.0, 0.0, -2.0)])
def test_holds_position_after_tumble_and_under_push(push):
    hover, last = GeometricHover(LIMITS, DT), []

    def decide(x, acting):
        if last:
            hover.feel(last[-1], x, acting)
        last.append(x)
        return hover.command(x, np.array([0.0, 0.0, 1.0]))

    path = fly_once(state((0.8, -0.5, 1.5), (0.9, -0.6, 0.4), (1.0, -1.0, 0.5)), decide, np.array(push), 500)
    assert np.abs(path[:, :3]).max() < 4.0
    assert np.linalg.norm(path[-50:, :3] - [0.0, 0.0, 1.0], axis=1).max() < 0.05


@pytest.mark.parametrize("push", [(0.0, 0.0, 0.0), (1.5, 0.0, 2.0)])
def test_fallback_holds_then_sinks_then_stops(push):
    hover = GeometricHover(LIMITS, DT)
    fallback, modes, last = Fallback(hover), [], []

    def decide(x, acting):
        if last:
            hover.feel(last[-1], x, acting)
        last.append(x)
        u, mode = fallback.step(x, True, np.array([0.0, 0.0, 1.5]), land=False)
        modes.append(mode)
        return u

    path = fly_once(state((0.0, 0.0, 1.5)), decide, np.array(push), 400)
    landing_tick = modes.index(Mode.LANDED)
    assert modes[:landing_tick] == sorted(modes[:landing_tick])
    assert 95 <= modes.index(Mode.DESCEND) <= 101
    assert path[landing_tick, 2] <= 0.1
    assert abs(path[landing_tick, 14]) < 0.8
    assert np.abs(path[:landing_tick, :2]).max() < 0.6


def test_blind_fallback_levels_and_sinks_and_stops_after_two_seconds():
    fallback = Fallback(GeometricHover(LIMITS, DT))
    x = state((0.0, 0.0, 3.0), (0.4, 0.2, 0.0))
    result = [fallback.step(x, False, x[:3], land=False) for _ in range(102)]
    assert {mode for _, mode in result[:99]} == {Mode.BLIND}
    assert result[-1][1] == Mode.DROP
    assert result[0][1] == Mode.BLIND
    R = rotation(np.array([0.4, 0.2, 0.0])) @ rotation(0.05 * result[0][0][1:])
    assert R[2, 2] > rotation(np.array([0.4, 0.2, 0.0]))[2, 2]
    assert (result[50][0][1:] == 0.0).all()
    assert 0.9 * G < result[50][0][0] < G
    # When the state is available again, the vehicle holds.
    observation = Fallback(GeometricHover(LIMITS, DT))
    observation.step(x, False, x[:3], land=False)
    assert observation.step(x, True, x[:3], land=False)[1] == Mode.HOLD
