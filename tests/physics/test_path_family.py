"""A family of command paths: coordinates and paths are inverse, and beliefs are calibrated and change slowly."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from retrim.physics.path_family import COORDINATES, PathBelief, PathFamily

FAMILY = PathFamily.of()


@eqx.filter_jit
def again(at):
    path = FAMILY.path(at)
    response = path.response
    ringing = 1.0 / (1.0 + 2.0 / jnp.maximum(response.inverse_damping[0], 1e-6) ** 2)
    return FAMILY.coordinates(path.delay, response.rate_lag[0], ringing, response.thrust_lag)


@pytest.mark.parametrize("seed", range(5))
def test_coordinates_invert_path(seed):
    at = random.uniform(random.key(seed), (COORDINATES,), minval=-1.0, maxval=1.0)
    np.testing.assert_allclose(again(at), at, atol=1e-5)


def test_coordinates_cover_ranges():
    fast, slow = FAMILY.path(-jnp.ones(COORDINATES)), FAMILY.path(jnp.ones(COORDINATES))
    assert float(fast.delay) == pytest.approx(0.0, abs=1e-7)
    assert float(slow.delay) == pytest.approx(0.1, rel=1e-5)
    np.testing.assert_allclose(fast.response.rate_lag, 0.01, rtol=1e-5)
    np.testing.assert_allclose(slow.response.rate_lag, 0.25, rtol=1e-5)
    np.testing.assert_allclose(1.0 / slow.response.inverse_damping, 0.4, rtol=1e-5)
    assert float(slow.response.thrust_lag) == pytest.approx(0.15, rel=1e-5)


@pytest.fixture(scope="module")
def members():
    return jax.jit(jax.vmap(FAMILY.draw))(random.split(random.key(0), 4000))


def test_sampled_vehicle_is_within_its_belief(members):
    path, belief = members.path, members.belief
    low, high = jax.vmap(lambda each: each.ends)(belief)
    for i, values in ((0, path.delay), (1, path.response.rate_lag[:, 0]), (3, path.response.thrust_lag)):
        ends = [jax.vmap(lambda at: FAMILY.path(at))(end) for end in (low, high)]
        first, last = ((end.delay, end.response.rate_lag[:, 0], None, end.response.thrust_lag)[i] for end in ends)
        assert np.all(values >= first * (1 - 1e-4) - 1e-6)
        assert np.all(values <= last * (1 + 1e-4) + 1e-6)


def test_belief_is_calibrated(members):
    """The position of the vehicle within its interval is uniform."""
    low, high = jax.vmap(lambda each: each.ends)(members.belief)
    at = 2.0 * members.path.delay / 0.1 - 1.0
    wide = np.asarray(high[:, 0] - low[:, 0]) > 0.05
    share = (np.asarray(at - low[:, 0]) / np.asarray(high[:, 0] - low[:, 0]))[wide]
    counts, _ = np.histogram(share, bins=10, range=(0.0, 1.0))
    assert np.all(np.abs(counts - wide.sum() / 10) < 5.0 * np.sqrt(wide.sum() / 10))


def test_sampled_rate_loops_exceed_minimum_frequency(members):
    kappa, lag = members.path.response.inverse_damping[:, 0], members.path.response.rate_lag[:, 0]
    frequency = 2.0 / (np.maximum(kappa, 1e-6) * lag)
    assert frequency.min() > 4.0 * 0.999
    assert kappa.max() > 2.0  # fast loops ring


def test_belief_changes_at_its_pace_and_converges():
    belief, there = PathBelief.unknown(), PathBelief.between(0.2 * jnp.ones(4), 0.3 * jnp.ones(4))
    for _ in range(30):
        before, belief = belief, belief.towards(there, 0.05)
        for old, new in zip(before.ends, belief.ends, strict=True):
            assert np.all(np.abs(new - old) <= 0.05 + 1e-6)
    np.testing.assert_allclose(belief.vector(), there.vector(), atol=1e-6)


def test_belief_beyond_family_is_clipped():
    belief = PathBelief.between(jnp.array([-5.0, 2.0, -0.5, 0.0]), jnp.array([-2.0, 9.0, jnp.inf, 0.5]))
    np.testing.assert_allclose(belief.centre, [-1.0, 1.0, 0.25, 0.25])
    np.testing.assert_allclose(belief.half_width, [0.0, 0.0, 0.75, 0.25])


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"delay": (0.1, 0.1)}, "delay"),
        ({"rate_lag": (0.0, 0.2)}, "rate_lag"),
        ({"thrust_lag": (0.2, 0.1)}, "thrust_lag"),
        ({"least_damping": 0.0}, "least_damping"),
        ({"least_frequency": float("nan")}, "least_frequency"),
    ],
)
def test_invalid_ranges_are_refused(settings, name):
    with pytest.raises(ValueError, match=name):
        PathFamily.of(**settings)
