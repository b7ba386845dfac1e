"""Tracking: hand-computed rewards, starts, bounds, errors; a relative preview, equal in training and in flight."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import GOAL, draw_starts, random_command, random_state, replace_fields
from retrim.control import Policy, PolicyController
from retrim.learn import Env, rollout
from retrim.physics import Command, PointMass, State, small, so3
from retrim.plants import Measurement
from retrim.runtime import ControllerPilot
from retrim.tasks import L2Track, Preview, Reference, RelativeObs, Start, StateAndErrorObs, StateObs, Track, huber
from retrim.tasks.shapes import circle, star


@pytest.fixture(scope="module")
def loop():
    return circle()


@pytest.fixture(scope="module")
def climb():
    """Return a slow climb with a heading of 30 degrees, for hand-computed values."""
    return Reference.of(lambda t: [0.2 * t, 0.1 * t, 1.0, math.pi / 6.0], seconds=10.0)


def observe(kind, reference, history):
    """Return the observation of a tracking policy by its name in a preset."""
    limits = small().omega_max
    state = StateObs(jnp.array(GOAL), limits, history)
    return {
        "blind": state,
        "relative": RelativeObs(reference, limits, history),
        "both": StateAndErrorObs(reference, state),
        "preview": Preview(reference, limits, history),
    }[kind]


def tracking(reference, make=Track, *, history=2, spread=1.0, box=5.0, horizon=12, kind="preview"):
    observation = observe(kind, reference, history)
    return make(reference, observation, jnp.array(spread), jnp.array(box), 0.02, horizon)


rotation = jax.jit(so3.rotz)


@eqx.filter_jit
def state_on(reference, t):
    """Return the state of the reference at ``t``, level, with its heading."""
    here = reference(jnp.asarray(t))
    return State(here.p, so3.rotz(here.heading), here.v)


# ---- rewards

place = eqx.filter_jit(lambda reference, t: reference(t))
reward = eqx.filter_jit(lambda task, t, x, u: task.reward(t, x, u))


def test_paper_reward_by_hand(climb):
    """|p - p_ref| = 0.5 -> 0.125; |v - v_ref| = 2.5 -> 2; |u - u_hover| = 2.5 -> 2 with weight 0.1."""
    x = state_on(climb, 3.0)
    x = State(x.p + jnp.array([0.3, 0.0, -0.4]), x.R, x.v + jnp.array([0.0, 1.5, 2.0]))
    u = Command(jnp.array(9.81 - 1.5), jnp.array([0.0, 0.0, 2.0]))
    assert float(reward(tracking(climb), jnp.array(3.0), x, u)) == pytest.approx(-(0.125 + 2.0 + 0.1 * 2.0), rel=1e-9)


def test_sharp_reward_by_hand(climb):
    """|5 (p - p_ref)| = 2.5 -> 2; |v - v_ref| = 0.5 -> 0.125; |u - u_ref| = 1 -> 0.5, weighted by 0.1; 60 degrees."""
    x = state_on(climb, 3.0)
    R = rotation(jnp.array(math.pi / 6.0 + math.pi / 3.0))
    x = State(x.p + jnp.array([0.3, 0.0, -0.4]), R, x.v + jnp.array([0.3, 0.4, 0.0]))
    u = Command.of(place(climb, jnp.array(3.0)).u + jnp.array([0.6, 0.0, 0.8, 0.0]))
    expected = -(2.0 + 0.125 + 0.1 * 0.5 + 0.5 * (1.0 - 0.5))
    assert float(reward(tracking(climb, L2Track), jnp.array(3.0), x, u)) == pytest.approx(expected, rel=1e-6)


def test_l2_reward_compared_with_paper(loop, key):
    """Five times as sharp in position, with a different command, and half of 1 - cos of the heading error."""
    t, x, u = jnp.array(4.0), random_state(key), random_command(key)
    here, hover = place(loop, t), np.array([9.81, 0.0, 0.0, 0.0])
    off, commands = x.p - here.p, u.vector()
    nose = np.array([math.cos(float(here.heading)), math.sin(float(here.heading))])
    difference = -(huber(5.0 * off) - huber(off)) - 0.1 * (huber(commands - here.u) - huber(commands - hover))
    difference -= 0.5 * (1.0 - float(nose @ np.asarray(x.R)[:2, 0]))
    result = reward(tracking(loop, L2Track), t, x, u) - reward(tracking(loop), t, x, u)
    assert float(result) == pytest.approx(float(difference), rel=1e-12)
    near = replace_fields(state_on(loop, 4.0), p=here.p + jnp.array([0.0, 0.0, 0.1]))
    own = Command.of(here.u)
    assert float(reward(tracking(loop, L2Track), t, near, own)) == pytest.approx(-0.5 * (5.0 * 0.1) ** 2, rel=1e-6)


def test_maximum_of_each_reward(loop):
    """The sharp reward is zero, its maximum, for the reference with its command; the paper's reward prefers hover."""
    t, x = jnp.array(4.0), state_on(loop, 4.0)
    own = Command.of(place(loop, t).u)
    assert float(reward(tracking(loop, L2Track), t, x, own)) == pytest.approx(0.0, abs=1e-12)
    assert float(reward(tracking(loop, L2Track), t, x, Command.hover())) < -1e-3
    assert float(reward(tracking(loop), t, x, Command.hover())) == 0.0
    assert float(reward(tracking(loop), t, x, own)) < -1e-3


@pytest.mark.parametrize("make", [Track, L2Track])
def test_reward_is_differentiable_everywhere(make, loop, key):
    task, t = tracking(loop, make), jnp.array(4.0)
    slope = jax.jit(jax.grad(lambda xu, t: task.reward(t, *xu)))
    steep = 0.0
    for x, u in [(state_on(loop, 4.0), Command.of(place(loop, t).u)), (random_state(key), random_command(key))]:
        leaves = jax.tree.leaves(slope((x, u), t))
        assert all(np.isfinite(leaf).all() for leaf in leaves)
        steep = max(float(jnp.abs(leaf).max()) for leaf in leaves)
    assert steep > 0.1


# ---- errors and bounds


def test_error_depends_on_time_and_cross_track_error_does_not(loop):
    """Half a lap late on a circle of 1 m, the vehicle is 2 m behind, and on the track."""
    with jax.numpy_dtype_promotion("standard"):
        task, x = tracking(loop), state_on(loop, 4.0)
        error, across = eqx.filter_jit(task.error), eqx.filter_jit(task.cross_track)
        assert float(error(jnp.array(4.0), x)) == 0.0
        assert float(error(jnp.array(7.0), x)) == pytest.approx(0.0, abs=1e-8)  # a whole lap later
        assert float(error(jnp.array(5.5), x)) == pytest.approx(2.0, abs=1e-3)
        assert float(across(x)) < 0.007
        outside = replace_fields(x, p=x.p + 0.25 * (x.p - jnp.array([1.0, 0.0, 1.0])))
        assert float(across(outside)) == pytest.approx(0.25, abs=1e-3)
        assert float(error(jnp.array(4.0), outside)) == pytest.approx(0.25, abs=1e-3)


def test_box_moves_with_reference(loop):
    terminated = eqx.filter_jit(tracking(loop, box=0.5).terminated)
    x = state_on(loop, 4.0)
    assert not terminated(jnp.array(4.0), x)
    assert terminated(jnp.array(5.5), x)  # the box has moved on
    for axis in range(3):
        for off, inside in ((0.49, True), (0.51, False), (-0.51, False)):
            assert bool(terminated(jnp.array(4.0), replace_fields(x, p=x.p.at[axis].add(off)))) is not inside
    assert terminated(jnp.array(4.0), replace_fields(x, p=x.p.at[0].set(jnp.nan)))
    assert terminated(jnp.array(4.0), replace_fields(x, v=x.v.at[0].set(jnp.inf)))


@eqx.filter_jit
def start_offsets(reference, start):
    return jax.vmap(reference)(start.t), jax.vmap(so3.log)(start.x.R)


@pytest.mark.parametrize("spread", [0.3, 1.0])
def test_starts_fill_their_bounds(spread, loop):
    task = tracking(loop, spread=spread)
    start = draw_starts(task, random.key(3), 3000)
    here, turns = start_offsets(loop, start)
    away = np.abs(np.asarray(start.x.p - here.p))
    assert away.max() <= spread
    assert away.max(axis=0).min() > 0.97 * spread  # and extend over the whole range
    assert (np.asarray(start.x.v - here.v)).std() == pytest.approx(0.3, rel=0.05)
    assert np.abs(turns).max() <= 0.1 * math.pi + 1e-9  # its heading is zero
    assert np.abs(turns).max(axis=0).min() > 0.97 * 0.1 * math.pi
    # two of three on the lap, one of three on the path to it
    t = np.asarray(start.t)
    assert t.min() >= 0.0
    assert t.max() <= 6.0
    assert (t > 3.0).mean() == pytest.approx(2.0 / 3.0, abs=0.04)


def test_starts_are_reproducible_with_heading_of_reference(climb):
    task = tracking(climb)
    reset = eqx.filter_jit(task.reset)
    first, again, other = reset(random.key(1)), reset(random.key(1)), reset(random.key(2))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert not np.array_equal(first.x.p, other.x.p)
    R = np.asarray(draw_starts(task, random.key(1), 3000).x.R)
    headings = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    assert headings.mean() == pytest.approx(math.pi / 6.0, abs=0.02)


# ---- the preview


def observe_by(observation, t, x, last=None, memory=None):
    memory = observation.init(x) if memory is None else memory
    return view(observation, memory, jnp.array(t), x, Command.hover() if last is None else last)


view = eqx.filter_jit(lambda observation, *more: observation(*more))


@pytest.mark.parametrize("history", [0, 2, 3])
def test_preview_layout(history, loop, key):
    observation, t = Preview(loop, small().omega_max, history), 3.7
    x, memory = random_state(key), None
    for k in range(4):
        u = Command(jnp.array(9.81 * (1.0 + k)), jnp.array([6.0, 0.0, -4.0]) * k)
        o, memory = observe_by(observation, t, x, u, memory)
    assert o.shape == (observation.size,) == (35 + 4 * history,)
    soon = [loop(jnp.array(t + ahead)).p - x.p for ahead in (0.0, 0.08, 0.16, 0.28, 0.4)]
    np.testing.assert_allclose(o[:15], np.concatenate(soon), atol=1e-12)
    later = [(loop(jnp.array(t + ahead)).v - x.v) / 5.0 for ahead in (0.0, 0.2)]
    np.testing.assert_allclose(o[15:21], np.concatenate(later), atol=1e-12)
    np.testing.assert_array_equal(o[21:30], np.asarray(x.R).reshape(9))
    np.testing.assert_allclose(o[30:33], np.asarray(x.v) / 5.0)
    np.testing.assert_array_equal(o[33:35], [1.0, 0.0])
    newest = [[k, k, 0.0, -k] for k in range(4)][4 - history :]
    np.testing.assert_allclose(o[35:], np.reshape(newest, -1), atol=1e-12)


@pytest.mark.parametrize("history", [0, 2])
@pytest.mark.parametrize("kind", ["relative", "both"])
def test_observed_tracking_errors_by_hand(kind, history, loop, key):
    observation, t, x, memory = observe(kind, loop, history), 3.7, random_state(key), None
    for k in range(3):
        u = Command(jnp.array(9.81 * (1.0 + k)), jnp.array([6.0, 0.0, -4.0]) * k)
        o, memory = observe_by(observation, t, x, u, memory)
    here, commands = loop(jnp.array(t)), [[k, k, 0.0, -k] for k in range(3)][3 - history :]
    error = np.asarray(x.p - here.p) / 1.5, np.asarray(x.v - here.v) / 5.0
    own = (np.asarray(x.p) - np.asarray(GOAL)) / 1.5, np.asarray(x.v) / 5.0
    first, last = (error, ()) if kind == "relative" else (own, error)
    expected = [first[0], np.asarray(x.R).reshape(9), first[1], np.reshape(commands, -1), *last]
    assert o.shape == (observation.size,) == ((15 if kind == "relative" else 21) + 4 * history,)
    np.testing.assert_allclose(o, np.concatenate(expected), atol=1e-12)


@pytest.mark.parametrize("kind", ["relative", "both"])
def test_only_combined_observation_contains_position(kind, loop, key):
    """Reference and vehicle are translated together: the error is constant, and absolute positions change."""
    by, x = jnp.array([3.0, -7.0, 2.0]), random_state(key)
    shifted_loop = eqx.tree_at(lambda r: r.rows, loop, loop.rows.at[:, :3].add(by))
    see = jax.jit(lambda reference, x: observe_by(observe(kind, reference, 1), 4.4, x)[0])
    here, there = see(loop, x), see(shifted_loop, replace_fields(x, p=x.p + by))
    np.testing.assert_allclose(there[:3] - here[:3], (0.0 if kind == "relative" else by / 1.5), atol=1e-9)
    np.testing.assert_allclose(there[3:], here[3:], atol=1e-9)


def test_preview_contains_heading(climb):
    o, _ = observe_by(Preview(climb, small().omega_max, 0), 1.0, state_on(climb, 1.0))
    np.testing.assert_allclose(o[33:35], [math.cos(math.pi / 6.0), 0.5], atol=1e-12)
    np.testing.assert_allclose(o[:3], 0.0, atol=1e-12)


def test_preview_is_translation_invariant(loop, key):
    """If reference and vehicle are translated together, the observation is equal; if only one is, it differs."""
    by = jnp.array([3.0, -7.0, 2.0])
    shifted_loop = eqx.tree_at(lambda r: r.rows, loop, loop.rows.at[:, :3].add(by))
    x = random_state(key)
    see = jax.jit(lambda reference, x: observe_by(Preview(reference, small().omega_max, 1), 4.4, x)[0])
    there = replace_fields(x, p=x.p + by)
    np.testing.assert_allclose(see(shifted_loop, there), see(loop, x), atol=1e-12)
    assert float(jnp.abs(see(shifted_loop, x) - see(loop, x)).max()) > 1.0


@pytest.mark.parametrize("t0", [0.0, 1.7, 5.95])
@pytest.mark.parametrize("kind", ["preview", "blind", "relative", "both"])
def test_observations_in_simulation_and_flight_are_equal(t0, kind, loop, key):
    """From the states and times of a roll-out with any start, the pilot issues the commands of the roll-out."""
    task = tracking(loop, kind=kind)
    policy = Policy.of(task.observation.size, small(), key=key, hidden=(8,))
    # so that the observation has an effect
    policy = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf) + 0.1), policy)
    x0 = replace_fields(state_on(loop, t0), p=place(loop, jnp.array(t0)).p + 0.2)
    simulation = eqx.filter_jit(rollout)(Env(PointMass(0.02), task), policy, Start(jnp.array(t0), x0))
    simulation = jax.tree.map(np.asarray, simulation)
    pilot = ControllerPilot(PolicyController(task.observation, policy))
    pilot.reset(Measurement(7.0, x0))  # the clock of a plant may start anywhere
    for k in range(task.horizon):
        x = jax.tree.map(lambda leaf, k=k: jnp.asarray(leaf[k]), simulation.x)
        u = pilot.act(Measurement(7.0 + t0 + k * 0.02, x))
        np.testing.assert_allclose(u.vector(), [simulation.u.c[k], *simulation.u.omega[k]], rtol=1e-10)
    assert np.ptp(simulation.u.c) > 1e-4


def test_new_reference_needs_no_compilation(loop):
    """This allows a policy to fly unseen references."""
    traces = []

    @eqx.filter_jit
    def step(task, t, x):
        traces.append(1)
        return task.observation(task.observation.init(x), t, x, Command.hover())[0], task.reward(t, x, Command.hover())

    x, t = state_on(loop, 4.0), jnp.array(4.0)
    one, other = step(tracking(loop), t, x), step(tracking(star()), t, x)
    assert len(traces) == 1
    assert not np.allclose(one[0], other[0])


@pytest.mark.parametrize("make", [Track, L2Track])
def test_gradient_of_roll_out_is_finite(make, loop, key):
    task = tracking(loop, make)
    policy = jax.tree.map(
        lambda leaf: jnp.asarray(np.asarray(leaf) + 0.05),
        Policy.of(task.observation.size, small(), key=key, hidden=(8,)),
    )

    @eqx.filter_jit
    def slope(layers, start):
        cost = lambda layers: -jnp.mean(rollout(Env(PointMass(0.02), task), policy.with_params(layers), start).reward)  # noqa: E731
        return jax.grad(cost)(layers)

    for start in (task.reset(key), Start(jnp.array(4.0), state_on(loop, 4.0))):
        leaves = jax.tree.leaves(slope(policy.layers, start))
        assert all(np.isfinite(leaf).all() for leaf in leaves)
        assert max(float(jnp.abs(leaf).max()) for leaf in leaves) > 1e-4
