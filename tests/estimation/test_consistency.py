"""Consistency of two measurements: rigid motions pass, and each kind of contradiction is reported by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from retrim.estimation.consistency import NOISE_PRIOR, Consistency, contradictions
from retrim.physics import Command, PointMass, State, so3

DT = 0.02
NOISE = jnp.array(NOISE_PRIOR)


@jax.jit
def motion(key):
    """Return two states of an agile flight, one tick apart: 20 m/s, 40 m/s^2, 12 rad/s."""
    kp, kr, kv, kc, kw = random.split(key, 5)
    x = State(random.normal(kp, (3,)), so3.exp(random.normal(kr, (3,))), 8.0 * random.normal(kv, (3,)))
    u = Command(40.0 * random.uniform(kc, ()), 5.0 * random.normal(kw, (3,)))
    return x, PointMass(DT).step(x, u, jnp.array([4.0, -3.0, 2.0]))


find = jax.jit(lambda before, after: contradictions(before, after, DT, NOISE))


def names(result):
    return [name for name, value in vars(result).items() if bool(value)]


def test_agile_flight_is_consistent():
    for k in range(50):
        assert names(find(*motion(random.key(k)))) == []


@pytest.mark.parametrize("error", [1.0, -2.0, 20.0])
def test_wrong_velocity_contradicts_positions(error):
    before, after = motion(random.key(1))
    wrong = State(after.p, after.R, after.v + jnp.array([0.0, error, 0.0]))
    assert "velocity" in names(find(before, wrong))


def test_shifted_position_contradicts_velocities():
    before, after = motion(random.key(2))
    assert names(find(before, State(after.p + jnp.array([0.05, 0.0, 0.0]), after.R, after.v))) == ["velocity"]


def test_repeated_measurement_is_found():
    before, _ = motion(random.key(3))
    assert "repeated" in names(find(before, before))
    rest = State.at(jnp.array([0.0, 0.0, 1.0]))
    assert names(find(rest, rest)) == []


def test_attitude_jump_and_invalid_rotation_are_found():
    before, after = motion(random.key(4))
    rotated_state = State(after.p, so3.mul(after.R, so3.exp(jnp.array([0.0, 0.0, 1.5]))), after.v)
    assert names(find(before, rotated_state)) == ["attitude"]
    assert names(find(before, State(after.p, 1.2 * after.R, after.v))) == ["attitude"]


def test_impossible_acceleration_is_found():
    """Velocity and position agree, but no vehicle can reach them."""
    before, after = motion(random.key(5))
    v = before.v + jnp.array([4.0, 0.0, 0.0])
    assert names(find(before, State(before.p + 0.5 * DT * (before.v + v), after.R, v))) == ["acceleration"]


@pytest.mark.parametrize("field", ["p", "R", "v"])
def test_nonfinite_measurement_is_found(field):
    before, after = motion(random.key(6))
    bad = State(**{name: getattr(after, name) * (jnp.nan if name == field else 1.0) for name in ("p", "R", "v")})
    assert "not_finite" in names(find(before, bad))


def test_noise_widens_tolerance_up_to_limit():
    before, after = motion(random.key(7))
    off = State(after.p + jnp.array([0.012, 0.0, 0.0]), after.R, after.v)
    by_noise = [bool(contradictions(before, off, DT, jnp.array(noise)).velocity) for noise in (0.0, 1e-3, 2.5e-3, 1.0)]
    assert by_noise == [True, True, False, False]
    far = State(after.p + jnp.array([0.05, 0.0, 0.0]), after.R, after.v)
    assert bool(contradictions(before, far, DT, jnp.array(1.0)).velocity)
    np.testing.assert_array_equal(find(before, after).any, False)


def scale_memory(scale, key, *, noise=0.0, speed=1.0, ticks=150):
    """Return the memory after a flight back and forth with a wrong scale of measured velocities."""
    t = DT * jnp.arange(float(ticks))
    along = jnp.array([1.0, 0.5, -0.3])
    p, v = speed / 3.0 * jnp.outer(jnp.sin(3.0 * t), along), speed * jnp.outer(jnp.cos(3.0 * t), along)
    p += noise * random.normal(key, p.shape)
    v = scale * v + 10.0 * noise * random.normal(random.fold_in(key, 1), v.shape)
    xs = jax.vmap(State)(p, jnp.broadcast_to(jnp.eye(3), (ticks, 3, 3)), v)

    def tick(carry, x):
        last, memory = carry
        return (x, memory.after(last, x, DT, jnp.array(True))), None

    first = jax.tree.map(lambda leaf: leaf[0], xs)
    (_, memory), _ = jax.lax.scan(tick, (first, Consistency.start(first)), jax.tree.map(lambda leaf: leaf[1:], xs))
    return memory


scale_memory = jax.jit(scale_memory, static_argnames=("ticks",))


@pytest.mark.parametrize("speed", [0.8, 1.2])
@pytest.mark.parametrize(("scale", "wrong"), [(0.5, True), (1.7, True), (0.9, False), (1.0, False)])
def test_wrong_velocity_scale_is_found_in_motion(scale, wrong, speed):
    for noise in (0.0, 1e-3):
        memory = scale_memory(scale, random.key(0), noise=noise, speed=speed)
        assert bool(memory.scaled) == wrong
        assert (float(memory.doubt) > 0.8) == wrong


def test_noise_at_rest_is_not_wrong_scale():
    for noise in (1e-3, 5e-3, 2e-2):
        assert not bool(scale_memory(1.0, random.key(1), noise=noise, speed=0.0).scaled)


def test_constant_velocity_error_is_not_wrong_scale():
    v = jnp.array([0.1, 0.0, 0.0])
    x = State(jnp.zeros(3), jnp.eye(3), v)
    memory = Consistency.start(x)
    for k in range(50):
        shift = jnp.array([1e-5 * k, 0.0, 0.0])  # not equal bit for bit
        x, memory = State(shift, x.R, v), memory.after(x, State(shift, x.R, v), DT, jnp.array(True))
    assert not bool(memory.scaled)
    assert bool(memory.certain)
