"""Undeclared lateness of states: it is found by comparison with an inertial unit, and only if the vehicle moves."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from retrim.estimation.lateness import Lateness
from retrim.physics import State, so3

DT, FINE, TICKS = 0.02, 20, 150

pytestmark = pytest.mark.usefixtures("as_a_user")


def motion(key, size):
    """Return states, body rates, and mean accelerations over the last tick, of a smooth random motion.

    The rows are milliseconds apart; the motion begins at rest.
    """
    times = jnp.arange(TICKS * FINE) * DT / FINE
    frequencies = jnp.array([2.0, 5.0, 9.0])
    phases = random.uniform(key, (2, 3, 3), maxval=6.28)
    omega, a = size * jnp.sin(frequencies * times[:, None, None, None] + phases).mean(axis=-1).swapaxes(0, 1)
    a = 4.0 * a

    def step(x, row):
        omega, a = row
        h = DT / FINE
        after = State(x.p + h * x.v + 0.5 * h**2 * a, so3.mul(x.R, so3.exp(h * omega)), x.v + h * a)
        return after, after

    states = lax.scan(step, State.at(jnp.zeros(3)), (omega, a))[1]
    means = a.reshape(TICKS, FINE, 3).mean(axis=1)
    return states, omega[FINE - 1 :: FINE], means


@eqx.filter_jit
def observe_motion(key, late, age, *, size=1.0, noise=0.0, missing=None, gap=None):
    """Return the memory after each tick, for states that are ``late`` + ``age`` [s] old.

    The readings at the ticks ``missing`` are not finite, and the ticks before ``gap[1]`` from ``gap[0]`` on are missed.
    """
    states, omega, a = motion(key, size)
    rows = jnp.maximum(FINE * jnp.arange(1, TICKS + 1) - 1 - jnp.round((late + age) / DT * FINE).astype(int), 0)
    x = jax.tree.map(lambda leaf: leaf[rows], states)
    k_v, k_R, k_omega = random.split(random.fold_in(key, 1), 3)
    turn, change = 0.1 * noise * random.normal(k_R, (TICKS, 3)), noise * random.normal(k_v, (TICKS, 3))
    x = jax.vmap(lambda x, turn, change: State(x.p, so3.mul(x.R, so3.exp(turn)), x.v + change))(x, turn, change)
    omega = omega + noise * random.normal(k_omega, omega.shape) + jnp.array([0.05, -0.03, 0.02])  # bias
    if missing is not None:
        omega = omega.at[missing].set(jnp.nan)

    present = jnp.ones(TICKS, bool) if gap is None else (jnp.arange(TICKS) < gap[0]) | (jnp.arange(TICKS) >= gap[1])
    order = jnp.argsort(~present, stable=True)  # missed ticks at the end, where the caller ignores them
    x, omega, a = jax.tree.map(lambda leaf: leaf[order], (x, omega, a))
    successive = jnp.diff(order, prepend=-1) == 1

    def tick(carry, row):
        memory, before = carry
        x, omega, a, successive = row
        after = memory.observe(before, x, successive, successive, omega, a, age, DT)
        return (after, x), (after.value, after.late_readings(DT)[0], after.variance)

    first = jax.tree.map(lambda leaf: leaf[0], x)
    value, rates, variance = lax.scan(tick, (Lateness.start(DT, x.p.dtype), first), (x, omega, a, successive))[1]
    return value, rates, omega, variance


@pytest.mark.parametrize(
    ("noise", "lates", "ticks"), [(0.0, (0.0, 0.02, 0.06, 0.1), 0.25), (0.02, (0.0, 0.04, 0.1), 1.0)]
)
@pytest.mark.parametrize("age", [0.0, 0.03])
def test_lateness_is_found(noise, lates, ticks, age):
    """Noise of 20 mm/s hides a lateness of one tick for longer than 1.5 s."""
    for late in lates:
        for seed in range(3):
            value, *_ = observe_motion(random.key(seed), jnp.array(late), jnp.array(age), noise=jnp.array(noise))
            np.testing.assert_allclose(value[75:], late, atol=ticks * DT)


def test_lateness_between_ticks_is_found_to_half_a_tick():
    value, *_ = observe_motion(random.key(0), jnp.array(0.05), jnp.array(0.0))
    np.testing.assert_allclose(value[75:], 0.05, atol=0.5 * DT + 1e-3)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_vehicle_at_rest_shows_no_lateness(noise):
    """Noise alone is not evidence."""
    for seed in range(5):
        value, *_ = observe_motion(
            random.key(seed), jnp.array(0.06), jnp.array(0.0), size=jnp.array(0.0), noise=jnp.array(noise)
        )
        assert value.max() < 1e-3


def test_readings_become_as_late_as_states():
    _, rates, omega, _ = observe_motion(random.key(0), jnp.array(0.06), jnp.array(0.0))
    np.testing.assert_allclose(rates[75:], omega[72:-3], atol=0.01)


def test_missing_readings_change_little():
    value, *_ = observe_motion(random.key(0), jnp.array(0.06), jnp.array(0.0), missing=jnp.arange(40, TICKS, 10))
    assert np.all(np.isfinite(value))
    np.testing.assert_allclose(value[75:], 0.06, atol=0.01)


def test_missed_ticks_are_no_evidence():
    """After a gap, the stored readings are older than their places in the history."""
    value, *_, variance = observe_motion(random.key(0), jnp.array(0.06), jnp.array(0.03), gap=jnp.array([80, 90]))
    assert np.all(variance[80:93] == variance[79])
    assert np.all(variance[95] != variance[79])
    np.testing.assert_allclose(value[60:140], 0.06, atol=2e-3)
