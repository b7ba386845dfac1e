"""Keypoints: published values, whitening, and training of the encoder."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import GOAL, replace_fields
from keypoint_steps import begin, near_state, pixels_of, rotation, see, small_commands, step
from retrim.control import Policy, PolicyController
from retrim.learn import Env, rollout
from retrim.learn.encoder import pretrain_encoder
from retrim.physics import Command, PointMass, State, small, so3
from retrim.plants import Measurement
from retrim.runtime import ControllerPilot
from retrim.tasks import Hover, Keypoints, OccludedKeypoints, Start
from retrim.tasks.keypoints import FEATURE_LIMIT
from retrim.tasks.motions import NEAR

PUBLISHED = [
    (-0.427, -0.474), (0.402, -0.474), (0.402, 0.631), (-0.427, 0.631), (-0.012, 0.665), (-0.452, 0.078),
    (-0.012, -0.508),
]  # fmt: skip


def keypoints(**options):
    return Keypoints.of(jnp.array(GOAL), small().omega_max, **({"whitened": False} | options))


@pytest.fixture(scope="module")
def plain():
    return keypoints()


@pytest.fixture(scope="module")
def white():
    return keypoints(whitened=True)


def test_published_projections_at_goal(plain):
    pixels, visible = pixels_of(plain, State.at(jnp.array(GOAL)))
    np.testing.assert_allclose(pixels, PUBLISHED, atol=6e-4)
    assert visible.all()


# ---- keypoints


history = eqx.filter_jit(lambda o, x, omega: o.history(x, omega))
stack = eqx.filter_jit(lambda o, frames: o.stacked(frames))


def observe_motion(observation, x, us):
    """Return the observations of a point mass under the commands ``us``, as in flight, and the last state."""
    memory, last, display = begin(observation, x), Command.hover(), []
    for u in us:
        o, memory = see(observation, memory, x, last)
        x, last = step(x, u), u
        display.append(np.asarray(o))
    return np.array(display), memory, x


def test_wrong_shape_is_refused(plain):
    jax.make_jaxpr(lambda x: plain(plain.init(x), jnp.array(0.0), x, Command.hover()))(near_state())


def test_observation_layout(plain, key):
    us = small_commands(key, 6)
    display, _, _ = observe_motion(plain, near_state(), us)
    assert display.shape == (6, plain.size) == (6, 89)
    assert plain.size == 89
    pixels, _ = pixels_of(plain, near_state())
    np.testing.assert_allclose(np.clip(display[0, :14], -5, 5), np.reshape(pixels, 14), atol=1e-9)  # newest first
    np.testing.assert_allclose(display[3, 14:28], display[0, :14], atol=1e-12)  # one frame later than 60 ms ago
    np.testing.assert_array_equal(display[:, 70:77], 1.0)
    commands = [[float(u.c) / 9.81 - 1.0, *(np.asarray(u.omega) / [6.0, 6.0, 4.0])] for u in us[2:5]]
    np.testing.assert_allclose(display[5, 77:], np.reshape(commands, 12), atol=1e-12)


def test_equal_starts_have_equal_observations(key):
    noisy, us = keypoints(noise=2.0), small_commands(key, 4)
    first, again = observe_motion(noisy, near_state(), us)[0], observe_motion(noisy, near_state(), us)[0]
    np.testing.assert_array_equal(first, again)
    elsewhere = replace_fields(near_state(), v=near_state().v + 0.01)
    quiet = (
        observe_motion(keypoints(noise=0.0), elsewhere, us)[0]
        - observe_motion(keypoints(noise=0.0), near_state(), us)[0]
    )
    assert not np.allclose(observe_motion(noisy, elsewhere, us)[0] - first, quiet, atol=1e-4)  # different noise


def test_observation_is_projection_plus_stated_noise(plain):
    """In pixels: 1280 by 720 across an image that is 2 wide and high."""
    exact = np.asarray(pixels_of(plain, near_state())[0])
    noisy = keypoints(noise=3.0)
    starts = jax.vmap(lambda k: State(near_state().p, near_state().R, 0.1 * random.normal(k, (3,))))(
        random.split(random.key(4), 600)
    )

    @eqx.filter_jit
    def first(o, xs):
        return jax.vmap(lambda x: o(o.init(x), jnp.array(0.0), x, Command.hover())[0][:14])(xs)

    np.testing.assert_allclose(first(keypoints(), starts)[0].reshape(7, 2), exact, atol=1e-12)
    off = (np.asarray(first(noisy, starts)).reshape(-1, 7, 2) - exact) * np.array([640.0, 360.0])
    np.testing.assert_allclose(off.reshape(-1, 2).std(axis=0), 3.0, rtol=0.05)
    np.testing.assert_allclose(off.reshape(-1, 2).mean(axis=0), 0.0, atol=0.15)


@eqx.filter_jit
def slope(o, x):
    memory = o.init(x)
    return jax.jacobian(lambda x: o(memory, jnp.array(0.0), x, Command.hover())[0])(x)


@pytest.mark.parametrize("place", [(0.05, -0.1, 1.1), (0.9, 0.0, 1.0), (4.0, 0.0, 0.3)])
def test_gradient_of_observation_is_finite(place, white):
    x = State(jnp.array(place), rotation(jnp.array([0.1, 0.5, 0.0])), jnp.array([0.3, 0.0, 0.0]))
    leaves = jax.tree.leaves(slope(white, x))
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    if place[0] < 1.0:
        assert float(jnp.abs(leaves[0]).max()) > 0.01


@jax.jit
def move(x, omega):
    """Return the state one tick later."""
    return State(x.p + 0.02 * x.v, x.R @ so3.exp(0.02 * omega), x.v)


def test_initial_history_is_steady_motion(plain):
    """Position follows from velocity and attitude from body rates, step by step, oldest first."""
    omega, x = jnp.array([0.5, -0.3, 0.8]), near_state()
    frames = []
    for _ in range(13):
        frames.append(np.asarray(pixels_of(plain, x)[0]).reshape(14))
        last = x
        x = move(x, omega)
    np.testing.assert_allclose(history(plain, last, omega), frames, atol=1e-10)
    frames = np.array(frames)
    np.testing.assert_array_equal(stack(plain, jnp.asarray(frames)).reshape(5, 14), frames[[12, 9, 6, 3, 0]])


@pytest.fixture(scope="module")
def motions(white):
    """Return whitened features before clipping: of the motions of the whitening, and of others."""

    @jax.jit
    def whiten(key):
        stack = jax.vmap(lambda k: white.stacked(white.history(*NEAR.draw(k, white.goal))))
        return (stack(random.split(key, 20000)) - white.mean[None]) @ white.whiten.T

    return np.asarray(whiten(random.key(0))), np.asarray(whiten(random.key(5)))


def test_whitening(white, motions):
    """The covariance of the motions of the whitening is one, or less where a pixel contains only noise."""
    own, other = motions
    np.testing.assert_allclose(white.whiten, white.whiten.T, atol=1e-10)
    np.testing.assert_allclose(own.mean(axis=0), 0.0, atol=1e-9)
    C = own.T @ own / len(own)
    spectrum = np.linalg.eigvalsh(C)
    assert spectrum.max() <= 1.0 + 1e-6
    assert np.median(spectrum) > 0.95
    assert spectrum.min() > 0.3
    variance = other.var(axis=0)  # rare frames with distant points have a large weight
    assert 0.8 < np.median(variance) < 1.5
    np.testing.assert_allclose(other.mean(axis=0), 0.0, atol=0.1)


def test_features_of_other_motions_are_white(white, motions):
    """Clipping removes the large values of rare frames, for motions that did not determine the whitening."""
    own, other = (np.clip(features, -FEATURE_LIMIT, FEATURE_LIMIT) for features in motions)
    spectrum = np.linalg.eigvalsh(np.cov(other.T))
    assert spectrum.max() < 1.5
    np.testing.assert_allclose(np.sort(spectrum), np.linalg.eigvalsh(np.cov(own.T)), rtol=0.15, atol=0.02)
    assert np.mean(np.abs(motions[1]) > FEATURE_LIMIT) < 0.01


def test_features_are_clipped(white):
    wild = 2.5 * random.normal(random.key(3), (70,))
    features = white.features(wild)
    raw = white.whiten @ (wild - white.mean)
    assert float(jnp.abs(raw).max()) > 10.0
    np.testing.assert_array_equal(features, jnp.clip(raw, -5.0, 5.0))


@pytest.mark.parametrize(("dt", "depth", "stride"), [(0.02, 13, 3), (0.01, 25, 6), (0.06, 5, 1)])
def test_frames_are_60_ms_apart_at_every_rate(dt, depth, stride, plain):
    """The frames of a steady motion show the positions 0, 60, ..., 240 ms ago."""
    observation = keypoints(dt=dt)
    assert (observation.depth, observation.stride) == (depth, stride)
    assert stride * dt == pytest.approx(0.06)
    frames = history(observation, near_state(), jnp.zeros(3))
    assert frames.shape == (depth, 14)
    for i, display in enumerate(np.asarray(stack(observation, frames)).reshape(5, 14)):
        then = replace_fields(
            near_state(),
            p=jnp.asarray(np.asarray(near_state().p) - 0.06 * i * np.asarray(near_state().v)),
        )
        np.testing.assert_allclose(display, np.reshape(pixels_of(plain, then)[0], 14), atol=1e-12)
    # This also holds for the first observation of a flight.
    _, memory = see(observation, begin(observation, near_state()), near_state(), Command.hover())
    np.testing.assert_allclose(memory.frames, frames, atol=1e-12)


def test_unsuitable_rates_are_refused():
    with pytest.raises(ValueError, match=r"dt = 0\.05 s must divide the frame time"):
        keypoints(dt=0.05)


# ---- training and flight


@pytest.mark.usefixtures("optax_promotion")
def test_encoder_training(white, key):
    """In a hundred small steps the error decreases; the output layer and the limits are unchanged."""
    policy = Policy.of(white.size, small(), key=key, hidden=(16,))
    learner_state, errors = pretrain_encoder(policy, white, key, steps=100, batch=32)
    assert errors.shape == (100,)
    assert float(errors[-10:].mean()) < 0.75 * float(errors[:5].mean())
    jax.tree.map(np.testing.assert_array_equal, learner_state.layers[-1], policy.layers[-1])
    jax.tree.map(
        np.testing.assert_array_equal,
        (learner_state.u_hover, learner_state.u_min, learner_state.u_max),
        (policy.u_hover, policy.u_min, policy.u_max),
    )
    assert [l.weight.shape for l in learner_state.layers] == [l.weight.shape for l in policy.layers]
    for before, after in zip(policy.layers[:-1], learner_state.layers[:-1], strict=True):
        assert float(jnp.abs(after.weight - before.weight).max()) > 0.01


@pytest.mark.parametrize("occluded", [True, False])
def test_observations_in_simulation_and_flight_are_equal(occluded, white, key):
    """With noise and lost points, the pilot issues the commands of the roll-out from its states."""
    observation = replace_fields(white, noise=jnp.array(1.0))
    observation = OccludedKeypoints(observation, jnp.array(0.1)) if occluded else observation
    task = Hover(jnp.array(GOAL), observation, jnp.array(5.0), jnp.array(0.3), 0.02, 12)
    policy = Policy.of(observation.size, small(), key=key, hidden=(8,))
    policy = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf) + 0.02), policy)
    x0 = Start(jnp.array(0.0), State(jnp.array([0.6, 0.2, 1.2]), jnp.eye(3), jnp.array([0.5, 0.0, 0.0])))
    simulation = jax.tree.map(np.asarray, eqx.filter_jit(rollout)(Env(PointMass(0.02), task), policy, x0))
    pilot = ControllerPilot(PolicyController(observation, policy))
    pilot.reset(Measurement(0.0, x0.x))
    for k in range(task.horizon):
        x = jax.tree.map(lambda leaf, k=k: jnp.asarray(leaf[k]), simulation.x)
        u = pilot.act(Measurement(k * 0.02, x))
        np.testing.assert_allclose(u.vector(), [simulation.u.c[k], *simulation.u.omega[k]], rtol=1e-7)
    assert np.ptp(simulation.u.c) > 1e-3
