"""The rewards of the paper in hand-computed cases; starts; bounds; observations, equal in training and in flight."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import GOAL, draw_starts, hover_env, hover_task, random_command, random_state, replace_fields
from retrim.config import PRESETS, Setup
from retrim.control import Policy, PolicyController
from retrim.learn import rollout
from retrim.physics import Command, State, small, so3
from retrim.plants import Measurement
from retrim.runtime import ControllerPilot
from retrim.tasks import Hover, L2Hover, StateObs, huber


@pytest.mark.parametrize(
    ("y", "value"), [((3.0, 4.0, 0.0), 4.5), ((0.3, 0.4, 0.0), 0.125), ((0.6, 0.8, 0.0), 0.5), ((0.0, 0.0, 0.0), 0.0)]
)
def test_huber_of_norm(y, value):
    assert huber(jnp.array(y)) == pytest.approx(value, abs=1e-15)


def test_huber_gradient():
    np.testing.assert_array_equal(jax.grad(huber)(jnp.zeros(3)), 0.0)
    np.testing.assert_allclose(jax.grad(huber)(jnp.array([3.0, 4.0, 0.0])), [0.6, 0.8, 0.0], rtol=1e-14)
    np.testing.assert_allclose(jax.grad(huber)(jnp.array([0.3, 0.4, 0.0])), [0.3, 0.4, 0.0], rtol=1e-14)


def test_reward_by_hand():
    """|5 (p - p_des)| = 2.5 -> 2; |v| = 0.5 -> 0.125; |omega| = 2 -> 1.5; |u - u_hover| = sqrt(1.5^2 + 2^2) -> 2."""
    task = hover_task()
    x = State(jnp.array([0.5, 0.0, 1.0]), jnp.eye(3), jnp.array([0.0, 0.3, 0.4]))
    u = Command(jnp.array(9.81 + 1.5), jnp.array([0.0, 2.0, 0.0]))
    assert task.reward(jnp.array(0.0), x, u) == pytest.approx(-(2.0 + 0.1 * 0.125 + 0.1 * 1.5 + 0.5 * 2.0), rel=1e-12)
    assert task.reward(jnp.array(0.0), State.at(jnp.array(GOAL)), Command.hover()) == 0.0


reward = eqx.filter_jit(lambda task, t, x, u: task.reward(t, x, u))


@pytest.mark.parametrize("away", [(0.0, 0.0, 0.0), (0.03, 0.0, 0.04), (-0.6, 0.8, 0.0)])
def test_l2_reward_has_cusp_at_goal(away, key):
    """It is that of the paper - 3 (sqrt(d^2 + (1 cm)^2) - 1 cm), for any attitude, velocity and command."""
    x, u = random_state(key), random_command(key)
    x = replace_fields(x, p=jnp.asarray(np.array(GOAL) + away))
    paper, ours = (reward(task, jnp.array(0.0), x, u) for task in (hover_task(), hover_task(make=L2Hover)))
    d = math.hypot(*away)
    assert float(ours - paper) == pytest.approx(-3.0 * (math.hypot(d, 0.01) - 0.01), abs=1e-12)


@eqx.filter_jit
def slope(task, x):
    """Return the gradient of the reward by position, in hover."""
    return jax.grad(lambda p: task.reward(jnp.array(0.0), replace_fields(x, p=p), Command.hover()))(x.p)


def test_only_l2_reward_is_steep_near_goal():
    """At 3 cm, the slope of the paper's reward is 0.75 per metre, and that of the cusp is 2.85 more."""
    x = State.at(jnp.array(GOAL) + jnp.array([0.03, 0.0, 0.0]))
    slopes = [float(slope(task, x)[0]) for task in (hover_task(), hover_task(make=L2Hover))]
    assert slopes[0] == pytest.approx(-0.75)
    assert slopes[1] == pytest.approx(-0.75 - 3.0 * 0.03 / math.hypot(0.03, 0.01))


@pytest.mark.parametrize("make", [Hover, L2Hover])
def test_reward_is_differentiable_everywhere(make, key):
    task = hover_task(make=make)
    gradient_of = jax.jit(jax.grad(lambda xu: task.reward(jnp.array(0.0), *xu)))
    for x, u in [(State.at(jnp.array(GOAL)), Command.hover()), (random_state(key), random_command(key))]:
        gradient = gradient_of((x, u))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("heading", [math.pi, 0.1 * math.pi])
def test_starts_fill_their_bounds(heading):
    task = hover_task(heading=heading)
    x = draw_starts(task, random.key(3), 2000).x
    away = np.asarray(x.p) - GOAL
    assert np.abs(away).max() <= 1.0
    assert np.abs(away).max(axis=0).min() > 0.95  # and extend over the whole range
    gram = np.einsum("nij,nkj->nik", x.R, x.R)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-12)
    tilt = np.arccos(np.asarray(x.R)[:, 2, 2])
    assert tilt.max() <= math.hypot(0.1 * math.pi, 0.1 * math.pi)
    yaw = np.abs(np.arctan2(np.asarray(x.R)[:, 1, 0], np.asarray(x.R)[:, 0, 0]))
    assert 0.9 * heading < yaw.max() <= heading + 0.15
    assert np.asarray(x.v).std() == pytest.approx(0.1, rel=0.05)


def test_termination():
    task, t = hover_task(box=2.0), jnp.array(0.0)
    assert not task.terminated(t, State.at(jnp.array([1.9, 0.0, 1.0])))
    assert task.terminated(t, State.at(jnp.array([2.1, 0.0, 1.0])))
    assert task.terminated(t, State.at(jnp.array([jnp.nan, 0.0, 1.0])))
    x = State.at(jnp.array(GOAL))
    assert task.terminated(t, replace_fields(x, v=jnp.array([jnp.inf, 0.0, 0.0])))


def test_error_is_distance():
    assert hover_task().error(jnp.array(0.0), State.at(jnp.array([0.3, 0.4, 1.0]))) == pytest.approx(0.5)


@pytest.mark.parametrize("history", [0, 2, 3])
def test_observation_layout(history, key):
    observation = StateObs(jnp.array(GOAL), small().omega_max, history)
    x, memory = random_state(key), None
    memory = observation.init(x)
    commands = [Command(jnp.array(9.81 * (1.0 + k)), jnp.array([6.0, 0.0, -4.0]) * k) for k in range(4)]
    for u in commands:
        o, memory = observation(memory, jnp.array(0.0), x, u)
    assert o.shape == (observation.size,) == (15 + 4 * history,)
    np.testing.assert_allclose(o[:3], (np.asarray(x.p) - GOAL) / 1.5)
    np.testing.assert_array_equal(o[3:12], np.asarray(x.R).reshape(9))
    np.testing.assert_allclose(o[12:15], np.asarray(x.v) / 5.0)
    newest = [[k, k, 0.0, -k] for k in range(4)][4 - history :]
    np.testing.assert_allclose(o[15:], np.reshape(newest, -1), atol=1e-12)


def test_observations_in_simulation_and_flight_are_equal(key):
    """From the states of a simulated roll-out, the pilot issues the commands of the roll-out."""
    env = hover_env(horizon=12, history=3)
    task = env.task
    policy = Policy.of(task.observation.size, small(), key=key, hidden=(8,))
    # so that the observation has an effect
    policy = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf) + 0.1), policy)
    x0 = eqx.filter_jit(task.reset)(key)
    simulation = jax.tree.map(np.asarray, eqx.filter_jit(rollout)(env, policy, x0))
    pilot = ControllerPilot(PolicyController(task.observation, policy))
    pilot.reset(Measurement(0.0, x0.x))
    for k in range(task.horizon):
        x = jax.tree.map(lambda leaf, k=k: jnp.asarray(leaf[k]), simulation.x)
        u = pilot.act(Measurement(k * 0.02, x))
        np.testing.assert_allclose(u.vector(), [simulation.u.c[k], *simulation.u.omega[k]], rtol=1e-12)


rotation = jax.jit(so3.log)


def test_flight_starts_are_equal_for_every_preset():
    starts = [Setup.from_preset(preset).flight_starts(8) for preset in PRESETS.values()]
    for others in starts[1:]:
        jax.tree.map(np.testing.assert_array_equal, starts[0], others)
    for x in starts[0]:
        assert np.linalg.norm(rotation(x.R)) < math.sqrt(3) * 0.1 * math.pi
