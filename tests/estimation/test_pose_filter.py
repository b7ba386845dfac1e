"""The pose filter converges, predicts without visible points, and tolerates an outlier."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import GOAL, first_order, random_command, replace_fields, stack_trees
from keypoint_steps import small_commands
from retrim.estimation import Camera, PoseFilter
from retrim.estimation.camera import in_camera
from retrim.physics import Command, LaggedModel, PointMass, State, so3
from retrim.tasks.keypoints import PATTERN

DT = 0.02
CAMERA = Camera.published()
GROUND = jnp.concatenate([jnp.array(PATTERN), jnp.zeros((7, 1))], axis=1)


@jax.jit
def pixels_at(x):
    return jax.vmap(CAMERA.project)(in_camera(x, GROUND)).pixel


@eqx.filter_jit
def track(estimate, x, us, visible):
    """Run the filter on a point mass; ``visible`` (ticks x 7) states which points it receives."""
    noise = 2.0 * 0.5 / CAMERA.size

    def tick(carry, step):
        estimate, x = carry
        u, observation = step
        x = PointMass(DT).step(x, u, jnp.zeros(3))
        estimate = estimate.predict(u, DT).correct(CAMERA, GROUND, pixels_at(x), observation, noise)
        gap = estimate.x.p - x.p, so3.log(x.R.T @ estimate.x.R), estimate.x.v - x.v
        return (estimate, x), (jnp.stack([jnp.sqrt(jnp.sum(g**2)) for g in gap]), estimate.P)

    (estimate, x), (gaps, covariances) = lax.scan(tick, (estimate, x), (us, visible))
    return estimate, x, gaps, covariances


@eqx.filter_jit
def correct(estimate, pixels, visible):
    return estimate.correct(CAMERA, GROUND, pixels, visible, 1.0 / CAMERA.size)


def hover_commands(n):
    return [Command.hover()] * n


@pytest.mark.parametrize("seed", range(3))
def test_converges_from_initial_estimate(seed):
    x = State.at(jnp.array(GOAL))
    start = PoseFilter.near(x, random.key(seed))
    assert float(jnp.linalg.norm(start.x.p - x.p)) > 0.01
    _, _, gaps, _ = track(start, x, stack_trees(hover_commands(40)), jnp.ones((40, 7), dtype=bool))
    assert float(gaps[15:, 0].max()) < 2e-3  # m
    assert float(gaps[15:, 1].max()) < 2e-3  # rad
    assert float(gaps[25:, 2].max()) < 0.02  # m/s


def test_initial_covariance_equals_initial_errors():
    x = State.at(jnp.array(GOAL))
    starts = jax.jit(jax.vmap(lambda k: PoseFilter.near(x, k)))(random.split(random.key(8), 2000))
    np.testing.assert_allclose((starts.x.p - x.p[None]).std(axis=0), 0.1, rtol=0.08)
    np.testing.assert_allclose(jax.vmap(so3.log)(starts.x.R).std(axis=0), 0.05, rtol=0.08)
    np.testing.assert_allclose(starts.x.v.std(axis=0), 0.2, rtol=0.08)
    np.testing.assert_allclose(np.diag(starts.P[0]), np.repeat([0.01, 0.0025, 0.04, 1.0], 3))
    np.testing.assert_array_equal(starts.d, 0.0)  # no disturbance has been estimated yet


def test_predicts_without_visible_points(key):
    """After 15 ticks without any point, under known commands, the error stays small and the variance grows."""
    us = stack_trees(hover_commands(25) + [random_command(k) for k in random.split(key, 15)])
    dark = jnp.arange(40)[:, None] < jnp.full((1, 7), 25)
    x0 = State.at(jnp.array(GOAL))
    _, x, gaps, P = track(PoseFilter.near(x0, key), x0, us, dark)
    assert float(jnp.linalg.norm(x.v)) > 0.1  # the vehicle has moved
    assert float(gaps[-1, 0]) < 5e-3
    assert float(gaps[-1, 1]) < 5e-3
    doubt = jnp.trace(P[:, :3, :3], axis1=1, axis2=2)
    assert (np.diff(doubt[24:]) > 0.0).all()
    assert float(doubt[-1]) > 10.0 * float(doubt[24])


def test_each_point_reduces_covariance(key):
    """A hidden point changes nothing."""
    x = State.at(jnp.array(GOAL))
    estimate = PoseFilter.near(x, key)
    pixels = pixels_at(x)
    for i in range(7):
        after = correct(estimate, pixels, jnp.arange(7) == i)
        shrunk = np.linalg.eigvalsh(estimate.P - after.P)
        assert shrunk.min() > -1e-12
        assert (shrunk > 1e-4).sum() == 2  # two coordinates reduce the variance in two directions
        assert float(jnp.trace(after.P)) < float(jnp.trace(estimate.P))
    none = correct(estimate, pixels, jnp.zeros(7, dtype=bool))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), none, estimate)


def test_covariance_stays_symmetric_and_positive(key):
    """Points appear and disappear at random."""
    kv, ku, ks = random.split(key, 3)
    us = stack_trees(small_commands(ku, 40))
    observation = random.uniform(kv, (40, 7)) < 0.3
    x0 = State.at(jnp.array(GOAL))
    _, _, gaps, P = track(PoseFilter.near(x0, ks), x0, us, observation)
    np.testing.assert_allclose(P, np.swapaxes(P, 1, 2), atol=1e-15)
    assert np.linalg.eigvalsh(P).min() > 0.0
    assert float(gaps[20:, 0].max()) < 0.02


def test_outlier_is_rejected(key):
    x = State.at(jnp.array(GOAL))
    estimate, *_ = track(PoseFilter.near(x, key), x, stack_trees(hover_commands(40)), jnp.ones((40, 7), dtype=bool))
    pixels = pixels_at(x).at[2].set(jnp.array([-0.9, -0.9]))
    after = correct(estimate, pixels, jnp.ones(7, dtype=bool))
    assert float(jnp.linalg.norm(after.x.p - x.p)) < 0.02


@pytest.mark.parametrize("push", [(2.0, 2.0, 2.0), (-3.0, 1.0, -0.5)])
def test_constant_push_is_estimated(push, key):
    """A constant acceleration that no command explains is distinguished from tilt within a second."""
    x, estimate, noise = State.at(jnp.array(GOAL)), PoseFilter.near(State.at(jnp.array(GOAL)), key), 1.0 / CAMERA.size
    hold = Command.hover()

    @jax.jit
    def tick(estimate, x):
        x = PointMass(DT).step(x, hold, jnp.array(push))
        observation = jnp.ones(7, dtype=bool)
        return estimate.predict(hold, DT).correct(CAMERA, GROUND, pixels_at(x), observation, noise), x

    for _ in range(30):
        estimate, x = tick(estimate, x)
    np.testing.assert_allclose(estimate.d, push, atol=0.1)
    assert float(jnp.linalg.norm(estimate.x.v - x.v)) < 0.05


def test_first_correction_may_be_large():
    """One correction from seven points removes an error of 25 cm and 8 degrees, up to the error of linearisation."""
    x = State.at(jnp.array([0.1, 0.2, 1.2]))
    estimate = PoseFilter.near(x, random.key(0))
    off = State(x.p + jnp.array([0.2, -0.1, 0.15]), so3.exp(jnp.array([0.1, -0.05, 0.08])), x.v)
    after = correct(replace_fields(estimate, x=off), pixels_at(x), jnp.ones(7, dtype=bool))
    assert float(jnp.linalg.norm(after.x.p - x.p)) < 0.01
    assert float(jnp.linalg.norm(so3.log(x.R.T @ after.x.R))) < 0.01


@pytest.mark.parametrize("tau", [0.03, 0.06])
def test_prediction_includes_lag(tau, key):
    """Without visible points, under a jump of the command, the filter follows a vehicle with lag only if it models the
    lag.
    """
    plant = LaggedModel(PointMass(DT), first_order(tau))
    x0 = State.at(jnp.array(GOAL))
    start = replace_fields(PoseFilter.near(x0, key), x=x0)
    jumps = [Command(jnp.array(15.0), jnp.array([3.0, -2.0, 1.0]))] * 6

    @eqx.filter_jit
    def fly_once(us, lag):
        def tick(carry, u):
            s, estimate = carry
            return (plant.step(s, u, jnp.zeros(3)), estimate.predict(u, DT, lag)), None

        (s, estimate), _ = lax.scan(tick, (plant.init(x0), start), us)
        return jnp.linalg.norm(plant.state(s).v - estimate.x.v)

    assert float(fly_once(stack_trees(jumps), jnp.array(tau))) < 1e-9
    assert float(fly_once(stack_trees(jumps), None)) > 0.1
