"""The thrust preview: invariances of its numbers, and the effect of a known disturbance on them."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random
from jax.test_util import check_grads

from helpers import at
from retrim.config.loading import load
from retrim.config.setup import Setup
from retrim.control.network_policy import NetworkPolicy
from retrim.control.thrust_network import ThrustNetwork
from retrim.errors import ConfigError
from retrim.physics import Command, State, so3
from retrim.physics.effective_gravity import EffectiveGravityFrame
from retrim.physics.state import STANDARD_GRAVITY
from retrim.physics.vehicle import small
from retrim.tasks.free_heading import with_free_heading
from retrim.tasks.shapes import figure8
from retrim.tasks.thrust_preview import POINTS, ThrustPreview

REFERENCE = figure8()
OBSERVATION = ThrustPreview(REFERENCE, jnp.ones(3))
T = jnp.array(4.3)
X = State(
    REFERENCE(T).p + jnp.array([0.1, -0.05, 0.02]), so3.exp(jnp.array([0.2, -0.1, 0.3])), jnp.array([0.5, 1.0, 0.1])
)
LAST = Command(jnp.array(9.0), jnp.array([0.1, 0.2, -0.1]))


@eqx.filter_jit
def first_observation(observation, x, last):
    return observation(observation.init(x), T, x, last)[0]


def observe(observation, x=X, last=LAST):
    return np.asarray(first_observation(observation, x, last))


def constant(a):
    return lambda x, u: jnp.array(a)


def test_constant_residual_and_frame_of_same_push_give_same_directions():
    d = (1.5, -1.0, 0.5)
    frame = EffectiveGravityFrame.of(jnp.array(d))
    framed = observe(OBSERVATION.in_frame(frame), frame.state(X), frame.command(LAST))
    scale = float(frame.scale)
    plain = observe(OBSERVATION.with_residual(constant(d)))
    end = 6 + 3 * POINTS
    np.testing.assert_allclose(framed[:end], scale * plain[:end], atol=1e-5)
    np.testing.assert_allclose(framed[end : end + 2], plain[end : end + 2], atol=1e-5)


def test_observed_vectors_rotate_with_vehicle():
    turn = so3.exp(jnp.array([0.4, 0.2, -0.6]))
    before, after = (observe(OBSERVATION, State(X.p, R, X.v)) for R in (X.R, so3.mul(X.R, turn)))
    count = 2 + POINTS
    vectors = before[: 3 * count].reshape(count, 3)
    np.testing.assert_allclose(after[: 3 * count].reshape(count, 3), vectors @ np.asarray(turn), atol=1e-5)


def test_velocity_dependent_residual_is_evaluated_along_reference():
    drag = OBSERVATION.with_residual(lambda x, u: -0.4 * x.v)
    end = 6 + 3 * POINTS
    change = (observe(drag) - observe(OBSERVATION))[6:end].reshape(POINTS, 3) * STANDARD_GRAVITY
    ahead = at(REFERENCE, float(T) + 0.04 * np.arange(POINTS)).v
    expected = 0.4 * (np.asarray(X.v)[None] + ahead - ahead[:1])
    np.testing.assert_allclose(change, expected @ np.asarray(X.R), atol=1e-4)


def test_network_commands_hover_at_rest():
    vehicle = small()
    network = ThrustNetwork.of(OBSERVATION.size, vehicle, random.key(0), (8,))
    rest = dataclasses.replace(OBSERVATION, reference=figure8(1e-3, 1e-3))
    x = State.at(rest.reference(T).p)
    o = first_observation(rest, x, Command.hover())
    np.testing.assert_allclose(network(o), np.zeros(4), atol=0.05)


@pytest.mark.parametrize("length", [3.0, 8.0])
def test_free_heading_turns_about_thrust_axis_at_constant_rate(length):
    free, plain = with_free_heading(figure8(length, 1.0)), figure8(length, 1.0)
    np.testing.assert_array_equal(free.rows[:, :7], plain.rows[:, :7])
    rates, own = np.asarray(free.rows[:, 7:10]), np.asarray(plain.rows[:, 7:10])
    on_lap = np.arange(len(rates)) * float(free.every) > float(free.lap[0]) + 0.02
    np.testing.assert_allclose(rates[on_lap, 2], rates[on_lap][0, 2], atol=1e-6)
    # The rate at which the thrust axis tilts does not depend on the heading.
    np.testing.assert_allclose(np.linalg.norm(rates[:, :2], axis=1), np.linalg.norm(own[:, :2], axis=1), atol=0.02)


def test_free_heading_closes_lap():
    free = with_free_heading(figure8(8.0, 3.0))
    start, end = (free(jnp.array(t)).heading for t in (float(free.lap[0]), float(free.lap[1]) - 1e-4))
    np.testing.assert_allclose([np.cos(start), np.sin(start)], [np.cos(end), np.sin(end)], atol=0.02)


def test_gradient_of_network_equals_finite_differences():
    network = ThrustNetwork.of(OBSERVATION.size, small(), random.key(1), (8, 8))
    o = first_observation(OBSERVATION, X, LAST)

    @jax.jit
    def output(gains, lead):
        return jnp.sum(dataclasses.replace(network, gains=jnp.asarray(gains), lead=jnp.asarray(lead))(o) ** 2)

    check_grads(output, (network.gains, network.lead), order=1, modes=["rev"], atol=1e-3, rtol=1e-3)


def test_limited_feedback_keeps_distant_vehicle_upright():
    network = ThrustNetwork.of(OBSERVATION.size, small(), random.key(1), (8,))
    policy = NetworkPolicy.create(network, small())
    far = State(X.p + jnp.array([50.0, -30.0, 0.0]), jnp.eye(3), REFERENCE(T).v)
    u = policy(first_observation(OBSERVATION, far, LAST))
    assert float(jnp.max(jnp.abs(u.omega))) <= 6.0 + 1e-3
    assert float(u.c) > 8.0


def test_network_refuses_observations_without_thrust_preview():
    preset = load("track/retrim")
    preset = dataclasses.replace(preset, pretrain=dataclasses.replace(preset.pretrain, network="thrust"))
    with pytest.raises(ConfigError, match="needs \\[track\\] observation = 'thrust'"):
        Setup.from_preset(preset).new_policy(random.key(0))
