"""DATT's observation is translation-invariant, its banded product is a convolution, and training lowers the error."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import GOAL, first_order, hover_task, random_command, random_state
from retrim.estimation.l1 import L1Estimator
from retrim.estimation.prediction import Prediction
from retrim.physics import Command, CommandPath, State, small
from retrim.testing import check_controller
from retrim_paper.datt.controller import SIZE, DattController, DattNet, _along, datt_command, datt_observation
from retrim_paper.datt.ppo import PpoSettings, PpoState, ppo
from retrim_paper.datt.problem import MAX_DISTURBANCE, DattProblem, reference_bank, ticks_of

pytestmark = pytest.mark.usefixtures("optax_promotion")
DT, TAU = 0.02, 0.033


def problem(n=8):
    vehicle = small()
    return DattProblem(jnp.asarray(reference_bank(0, n)), jnp.array(TAU), vehicle.command_min, vehicle.command_max)


def test_banded_product_is_convolution(key):
    k_x, k_w, k_b = random.split(key, 3)
    points, kernel, bias = random.normal(k_x, (10, 3)), random.normal(k_w, (3, 3, 8)), random.normal(k_b, (8,))
    plain = jax.jit(lambda points, taps: lax.conv_general_dilated(points.T[None], taps, (1,), "VALID")[0].T)
    result = jax.jit(_along)(points, kernel, bias)
    expected = np.asarray(plain(points, kernel.transpose(2, 1, 0))) + np.asarray(bias)
    np.testing.assert_allclose(result, expected, atol=1e-12)


def test_observation_is_translation_invariant(key):
    k_x, k_u, k_a = random.split(key, 3)
    x, u, d = random_state(k_x), random_command(k_u), jnp.array([0.5, -0.2, 0.1])
    ahead, shift = random.normal(k_a, (10, 3)), jnp.array([3.0, -2.0, 7.0])
    observation = jax.jit(datt_observation)
    here = observation(x, u, d, ahead)
    there = observation(State(x.p + shift, x.R, x.v), u, d, ahead + shift[None])
    assert here.shape == (SIZE,)
    np.testing.assert_allclose(here, there, atol=1e-12)


def test_commands_are_within_limits_and_zero_is_hover(key):
    low, high = small().command_min, small().command_max
    actions = jnp.concatenate([20.0 * random.normal(key, (8, 4)), jnp.zeros((1, 4))])
    u = np.asarray(jax.jit(jax.vmap(lambda action: datt_command(action, low, high).vector()))(actions))
    assert ((np.asarray(low.vector()) <= u) & (u <= np.asarray(high.vector()))).all()
    np.testing.assert_allclose(u[-1], Command.hover().vector())


def test_references_last_an_episode_and_start_at_rest():
    bank = reference_bank(3, 16)
    assert bank.shape[1] > ticks_of(0.02)
    assert np.isfinite(bank).all()
    assert (np.abs(bank).max(axis=(0, 1)) < 4.0).all()
    assert (bank[:, 0] == 0.0).all()
    assert np.abs(np.diff(bank, axis=1)).max() < 0.02 * 5.0  # at most 5 m/s
    assert (bank == reference_bank(3, 16)).all()
    assert (bank != reference_bank(4, 16)).any()


def test_episode_is_flight_of_lagged_model(key):
    """Disturbances stay in the range of training, the reward decreases with distance, and the episode ends on time."""
    setup = problem()
    s = eqx.filter_jit(setup.reset)(key)
    step = eqx.filter_jit(setup.step)
    s_far = s._replace(x=State(s.x.p + 1.0, s.x.R, s.x.v))
    assert float(step(s_far, jnp.zeros(4), key)[1].reward) < float(step(s, jnp.zeros(4), key)[1].reward)
    s_end = s._replace(tick=jnp.array(ticks_of(0.02) - 1))
    after, outcome = step(s_end, jnp.zeros(4), key)
    assert bool(outcome.truncated)
    assert not bool(outcome.terminated)
    assert np.abs(after.d).max() <= MAX_DISTURBANCE


def test_training_changes_all_parts_and_gives_controller(key):
    """Every part of the network changes; the convergence of PPO is tested on a task with a known solution."""
    setup, fresh = problem(4), eqx.filter_jit(lambda key: DattNet.of(key=key))(key)
    settings = PpoSettings(envs=16, steps=8, minibatches=2, epochs=2)
    ((after, message),) = ppo(setup, PpoState.of(setup, fresh, key, settings), settings, steps=16 * 8)
    net = after.net
    assert np.isfinite(list(message.values())).all()
    for before, after in zip(jax.tree.leaves(fresh), jax.tree.leaves(net), strict=True):
        assert not eqx.is_array(before) or (not np.array_equal(before, after) and np.isfinite(after).all())
    estimator = L1Estimator(jnp.array(-0.2), jnp.array(0.95), DT)
    flight = DattController(
        net,
        hover_task(),
        Prediction.of(CommandPath.of(DT, first_order(TAU)), DT),
        estimator,
        jnp.array(MAX_DISTURBANCE),
        setup.low,
        setup.high,
    )
    check_controller(flight)
    memory = flight.init(State.at(jnp.array(GOAL)))
    assert not np.any(memory.estimate.d_hat)
