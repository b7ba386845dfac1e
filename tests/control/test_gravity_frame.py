"""The frame of the gravity that is felt: Eq. (1) is the same in it, exactly."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import GOAL, hover_env, random_command, random_state, replaced
from retrim.adapt.views import GravityView, TurnedResidual, WorldView
from retrim.control import Policy
from retrim.control.controller import PolicyController
from retrim.control.gravity_frame import GravityFrame, tilted, turned
from retrim.estimation.disturbance_observer import DisturbanceObserver
from retrim.learn import Env, Window, rollout
from retrim.physics import Command, Hybrid, PointMass, State, small, so3
from retrim.physics.actuators import Trimmed
from retrim.tasks import Start

PIVOT = jnp.array(GOAL)
PUSHES = [(0.0, 0.0, 0.0), (2.0, 2.0, 2.0), (-3.0, 1.0, -2.5), (0.0, 0.0, -6.0), (5.0, -3.0, 1.0)]


@pytest.mark.parametrize("d", PUSHES)
def test_the_frame_turns_felt_gravity_down(d):
    d = jnp.array(d)
    Q, extra = tilted(d)
    np.testing.assert_allclose(Q @ Q.T, np.eye(3), atol=1e-12)
    assert float(jnp.linalg.det(Q)) == pytest.approx(1.0)
    felt = jnp.array([0.0, 0.0, -9.81]) + d
    np.testing.assert_allclose(Q @ felt, [0.0, 0.0, -(9.81 + float(extra))], atol=1e-3)
    axis = jnp.cross(felt, jnp.array([0.0, 0.0, 1.0]))  # the smallest rotation leaves this one alone
    np.testing.assert_allclose(Q @ axis, axis, atol=1e-9)


@pytest.mark.parametrize("d", PUSHES)
@pytest.mark.parametrize("state_dependent", [False, True])
def test_a_tick_in_the_frame_is_a_tick_in_the_world(d, state_dependent, key):
    """From any state, under any command, with any residual: one tick of Eq. (1), turned before or after."""
    d, (k_x, k_u) = jnp.array(d), random.split(key)
    x, u = random_state(k_x), random_command(k_u)
    drag = 0.3 if state_dependent else 0.0
    residual = lambda x, u: d - drag * x.v + drag * u.c * x.R[:, 0]  # noqa: E731
    Q, extra = tilted(d)
    in_world = Hybrid(PointMass(0.02), residual).step(x, Command(u.c + extra, u.omega), jnp.zeros(3))
    model = Hybrid(Trimmed(PointMass(0.02), extra), TurnedResidual(residual, d, PIVOT))
    inside = model.step(turned(Q, PIVOT, x), u, jnp.zeros(3))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), inside, turned(Q, PIVOT, in_world))


def test_turning_there_and_back_is_nothing(key):
    Q, x = so3.exp(random.normal(key, (3,))), random_state(key)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), turned(Q.T, PIVOT, turned(Q, PIVOT, x)), x)


def test_a_constant_push_leaves_nothing_to_learn():
    """At rest in trim the view's residual is zero; so it is for a known push in every attitude that is level there."""
    env = hover_env()
    d = jnp.array([2.0, -1.0, 1.5])
    window = Window.of(
        np.arange(12.0), np.zeros((12, 3)), np.tile(np.eye(3), (12, 1, 1)), np.zeros((12, 3)), np.full(12, 9.81),
        np.zeros((12, 3)),
    )  # fmt: skip
    corrected, seen = GravityView(PIVOT, jnp.array(6.0))(env, lambda x, u: d, window)
    after = corrected.dynamics.step(State.at(PIVOT), Command.hover(), jnp.zeros(3))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), after, State.at(PIVOT))
    Q, extra = tilted(d)
    np.testing.assert_allclose(seen.x.p[0], PIVOT + Q @ (0.0 - PIVOT), atol=1e-9)
    np.testing.assert_allclose(seen.u.c, 9.81 - extra, atol=1e-9)
    same, window_too = WorldView()(env, lambda x, u: d, window)
    assert window_too is window
    np.testing.assert_array_equal(same.dynamics.residual(State.at(PIVOT), Command.hover()), d)


def test_the_frame_is_capped_and_defined_near_free_fall():
    """An estimate beyond the limit turns no farther; a falling vehicle still has a frame."""
    observer = DisturbanceObserver(PointMass(0.02), jnp.array(0.2), jnp.array(6.0), jnp.array(2.0))
    s = observer.init(State.at(jnp.zeros(3)))
    falling = State(jnp.zeros(3), jnp.eye(3), jnp.array([0.0, 0.0, -1e4]))
    s = observer(s, falling)
    assert float(jnp.linalg.norm(s.d_hat)) <= 6.0 + 1e-6
    Q, extra = tilted(s.d_hat)
    assert np.isfinite(Q).all()
    assert float(extra) > -9.81


@pytest.mark.parametrize("d", [(1.0, 0.5, -1.0), (-2.0, 2.0, 2.0)])
def test_a_flight_under_a_known_push_is_the_calm_flight_turned(d):
    """With a perfect estimate, the controller flies under a push as without one, but for the strength of gravity."""
    env, d = hover_env(horizon=60), jnp.array(d)
    policy = Policy.of(15, small(), key=random.key(3), hidden=(8, 8))
    inner = PolicyController(env.task.observation, policy)
    exact = DisturbanceObserver(PointMass(0.02), jnp.array(1e-9), jnp.array(9.0), jnp.array(jnp.inf))
    framed = GravityFrame(inner, exact, PIVOT)
    x0 = State(PIVOT + jnp.array([0.2, -0.1, 0.3]), so3.exp(jnp.array([0.1, 0.2, 0.0])), jnp.zeros(3))
    Q, extra = tilted(d)
    heavier = Hybrid(Trimmed(PointMass(0.02), extra), lambda x, u: jnp.array([0.0, 0.0, -1.0]) * extra)
    calm = eqx.filter_jit(rollout)(Env(heavier, env.task), policy, Start(jnp.array(0.0), x0))
    x = turned(Q.T, PIVOT, x0)

    @jax.jit
    def tick(memory, x, k):
        u, memory = framed(memory, 0.02 * k, x)
        return memory, PointMass(0.02).step(x, u, d)

    memory = framed.init(x)
    gained = 9.81 * x.R[:, 2] - jnp.array([0.0, 0.0, 9.81]) + d  # in the tick before the start, at hover thrust
    before = replaced(x, v=x.v - 0.02 * gained)
    memory = replaced(memory, observer=replaced(memory.observer, d_hat=d, last=before, v=before.v))
    positions = []
    for k in range(40):
        positions.append(turned(Q, PIVOT, x).p)
        memory, x = tick(memory, x, jnp.array(float(k)))
    np.testing.assert_allclose(np.stack(positions), calm.x.p[:40], atol=1e-6)
