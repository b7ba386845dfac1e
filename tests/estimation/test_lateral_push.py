"""A push is estimated from the acceleration perpendicular to the thrust, whatever the thrust is."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from retrim.estimation.command_path.lateral import PUSH, LateralPush
from retrim.physics.state import STANDARD_GRAVITY

N = 150


@jax.jit
def estimate(rows, keep):
    """Return the sums after each row of attitude, velocity and specific force."""

    def tick(sums, row):
        sums = sums.observe(*row, jnp.array(True), keep)
        return sums, sums

    return jax.lax.scan(tick, jax.tree.map(lambda x: x.astype(_dtype(x, keep)), LateralPush.start()), rows)[1]


def _dtype(x, keep):
    return x.dtype if x.dtype == bool else keep.dtype


def flight(rng, push, *, drag=0.3, noise=0.02, tilt=0.3):
    """Return random attitudes and velocities, and the specific force under a push for each row (n, 3)."""
    R = Rotation.from_rotvec(tilt * rng.normal(size=(N, 3))).as_matrix()
    v = rng.normal(size=(N, 3))
    thrust = STANDARD_GRAVITY * np.exp(0.3 * rng.normal(size=(N, 1)))
    return R, v, thrust * R[:, :, 2] + push - drag * v + noise * rng.normal(size=(N, 3))


def last(sums):
    return jax.tree.map(lambda x: x[-1], sums)


def test_push_is_within_its_interval():
    push = np.array([2.0, -1.0, 1.5])
    result = last(estimate(flight(np.random.default_rng(0), push), jnp.array(0.997))).push()
    deviation = np.sqrt(np.diag(np.linalg.inv(result.information)))
    assert np.all(np.abs(result.mean - push) < 3.0 * deviation)
    assert np.all(deviation < 0.1)


def test_single_outlier_does_not_count_and_two_show_a_jump():
    rng, push = np.random.default_rng(1), np.array([1.0, 1.0, 0.0])
    R, v, force = flight(rng, push)
    outlier = force.copy()
    outlier[100] += [8.0, -8.0, 0.0]
    keep = jnp.array(0.997)
    good, bad = (last(estimate((R, v, f), keep)) for f in (force, outlier))
    np.testing.assert_allclose(bad.push().mean, good.push().mean, atol=0.01)
    after = np.array([-2.0, 2.0, 1.0]) * (np.arange(N) >= 100)[:, None]
    sums = estimate((R, v, force + after), keep)
    assert np.flatnonzero(sums.jumped).tolist() == [101]
    np.testing.assert_allclose(last(sums).push().mean, push + after[-1], atol=0.05)


def test_straight_flight_keeps_prior_of_alike_directions_in_single_precision():
    """At a constant attitude and velocity, drag and push cannot be told apart; rounding must not decide."""
    n = 3000
    R = np.tile(Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix(), (n, 1, 1))
    v = np.tile([10.0, 0.0, 0.0], (n, 1))
    force = STANDARD_GRAVITY * R[:, :, 2] - 0.3 * v
    rows = tuple(jnp.array(x, jnp.float32) for x in (R, v, force))
    result = last(estimate(rows, jnp.float32(0.9995))).push_and_drag()
    information = np.asarray(result.information, float)
    assert np.linalg.eigvalsh(information).min() > 0.0
    assert np.all(np.abs(result.mean[:3]) < 2.0 * PUSH)
    assert 1.0 < np.sqrt(np.linalg.inv(information)[0, 0]) < PUSH
