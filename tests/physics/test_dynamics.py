"""Eq. (1), the order of its integrator, and gradients through hybrid and straight-through models."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import random_command, random_state
from retrim.physics import (
    Command,
    Constant,
    Hybrid,
    LinearDragQuadrotor,
    PointMass,
    Reversing,
    State,
    StraightThrough,
    f_a,
    small,
    so3,
)

G = 9.81
# Compiled programs: without jit, each operation would be compiled separately.
rate = jax.jit(f_a)
step = eqx.filter_jit(lambda model, x, u, a_ext: model.step(x, u, a_ext))


def test_acceleration_equals_equation_1_in_numpy(key):
    for k in random.split(key, 5):
        x, u = random_state(k), random_command(k)
        a_ext = np.array([0.5, -1.0, 2.0])
        R, w = np.asarray(x.R), np.asarray(u.omega)
        hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        result = rate(x, u, jnp.asarray(a_ext))
        np.testing.assert_allclose(result.p, x.v)
        np.testing.assert_allclose(R @ np.asarray(so3.hat(result.omega)), R @ hat)
        np.testing.assert_allclose(result.v, R @ [0, 0, float(u.c)] + [0, 0, -G] + a_ext, rtol=1e-14)


@jax.jit
def generic_rk4(x, u, a_ext, h):
    """Runge-Kutta 4 on the manifold, stage by stage; the model merges equal stages."""

    def move(rate, h):
        return State(x.p + h * rate.p, so3.mul(x.R, so3.exp(h * rate.omega)), x.v + h * rate.v)

    k1 = f_a(x, u, a_ext)
    k2 = f_a(move(k1, h / 2), u, a_ext)
    k3 = f_a(move(k2, h / 2), u, a_ext)
    k4 = f_a(move(k3, h), u, a_ext)
    return move(jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4), h)


def test_step_is_runge_kutta_4(key):
    for k in random.split(key, 5):
        x, u, a_ext = random_state(k), random_command(k), random.normal(k, (3,))
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, atol=1e-14),
            step(PointMass(0.02), x, u, a_ext),
            generic_rk4(x, u, a_ext, 0.02),
        )


def spin(t, w, c):
    """Return the closed form from rest with thrust c and constant roll rate w."""
    p = [0, -c * (t / w - np.sin(w * t) / w**2), c * (1 - np.cos(w * t)) / w**2 - G * t**2 / 2]
    v = [0, -c * (1 - np.cos(w * t)) / w, c * np.sin(w * t) / w - G * t]
    return np.array(p), np.array(v)


def fly_once(dt, seconds, u, x=None):
    x = State.at(jnp.zeros(3)) if x is None else x
    for _ in range(round(seconds / dt)):
        x = step(PointMass(dt), x, u, jnp.zeros(3))
    return x


# (what, closed form, tolerance at 50 Hz over 1 s)
@pytest.mark.parametrize(
    ("c", "w", "tolerance"), [(0.0, 1e-3, 1e-12), (9.81, 1e-3, 1e-9), (12.0, 2.0, 2e-8), (20.0, 6.0, 1e-5)]
)
def test_step_equals_closed_forms(c, w, tolerance):
    x = fly_once(0.02, 1.0, Command(jnp.array(c), jnp.array([w, 0.0, 0.0])))
    p, v = spin(1.0, w, c)
    np.testing.assert_allclose(x.p, p, atol=tolerance)
    np.testing.assert_allclose(x.v, v, atol=tolerance)
    np.testing.assert_allclose(x.R, so3.rotx(jnp.array(w)), atol=1e-12)


def test_order_of_accuracy_is_four():
    """Halving the step divides the error by 16, in position and in velocity."""
    u = Command(jnp.array(12.0), jnp.array([5.0, 0.0, 0.0]))
    p, v = spin(1.2, 5.0, 12.0)
    errors = np.array(
        [
            [np.linalg.norm(np.asarray(x.p) - p), np.linalg.norm(np.asarray(x.v) - v)]
            for x in (fly_once(dt, 1.2, u) for dt in (0.04, 0.02, 0.01))
        ]
    )
    orders = np.log2(errors[:-1] / errors[1:])
    np.testing.assert_allclose(orders, 4.0, atol=0.15)


def test_rotation_stays_orthogonal():
    x = fly_once(0.02, 3.0, Command(jnp.array(10.0), jnp.array([3.0, -2.0, 1.0])))
    R = np.asarray(x.R)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_published_single_step():
    """F = 5 N on 0.192 kg, from rest: 3.246 mm up in one tick, with and without a residual of zero."""
    u, x = Command(jnp.array(5.0 / 0.192), jnp.zeros(3)), State.at(jnp.zeros(3))
    for model in (PointMass(0.02), Hybrid(PointMass(0.02), lambda x, u: jnp.zeros(3))):
        assert model.step(x, u, jnp.zeros(3)).p[2] == pytest.approx(3.246e-3, abs=5e-7)


def network(key):
    w = random.normal(key, (3, 19))
    return lambda x, u: jnp.tanh(w @ jnp.concatenate([x.vector(), u.vector()]))


def flat_step(model, a_ext):
    """Return the step as a function of one vector (x, u) to one vector x, for Jacobians."""

    @jax.jit
    def step(y):
        x = State(y[:3], y[3:12].reshape(3, 3), y[12:15])
        return model.state(model.step(model.init(x), Command.of(y[15:]), a_ext)).vector()

    return step


def differences(step, y, h=1e-6):
    """Return its Jacobian by finite differences."""
    columns = jax.jit(jax.vmap(lambda e: (step(y + h * e) - step(y - h * e)) / (2 * h)))
    return np.asarray(columns(jnp.eye(19))).T


def test_residual_has_no_gradient(key):
    """The Jacobian is that of the analytical model by finite differences, and the value includes the residual."""
    x, u, a_ext = random_state(key), random_command(key), jnp.array([0.3, 0.0, -0.2])
    residual = network(key)
    y = jnp.concatenate([x.vector(), u.vector()])
    hybrid, hold = flat_step(Hybrid(PointMass(0.02), residual), a_ext), jax.jit(residual)(x, u)
    analytical = flat_step(PointMass(0.02), a_ext + hold)
    np.testing.assert_allclose(hybrid(y), analytical(y), atol=1e-15)
    J = jax.jit(jax.jacobian(hybrid))(y)
    np.testing.assert_allclose(J, differences(analytical, y), atol=1e-8)
    np.testing.assert_allclose(J[12:15, 12:15], np.eye(3), atol=1e-15)  # dv+/dv, although the residual depends on v


def test_backprop_option_differentiates_residual(key):
    x, u = random_state(key), random_command(key)
    y = jnp.concatenate([x.vector(), u.vector()])
    through = flat_step(Hybrid(PointMass(0.02), network(key), backprop=True), jnp.zeros(3))
    J = np.asarray(jax.jit(jax.jacobian(through))(y))
    np.testing.assert_allclose(J, differences(through, y), atol=1e-8)
    assert abs(J[12:15, 12:15] - np.eye(3)).max() > 1e-3


def test_straight_through_has_value_of_first_and_gradient_of_second_model(key):
    """The state types differ: a rotor-level model forward, and Eq. (1) backward."""
    x, u, a_ext = random_state(key, 0.3), random_command(key), jnp.array([0.5, 0.0, 0.0])
    rotors, simple = LinearDragQuadrotor.of(small(), 0.02), PointMass(0.02)
    model = StraightThrough(rotors, simple)
    y = jnp.concatenate([x.vector(), u.vector()])
    both, forward, backward = (flat_step(each, a_ext) for each in (model, rotors, simple))
    ways = jax.jit(lambda y: (both(y), forward(y), jax.jacobian(both)(y), jax.jacobian(backward)(y)))
    value, expected, slope, wanted_slope = ways(y)
    np.testing.assert_array_equal(value, expected)
    np.testing.assert_allclose(slope, wanted_slope, atol=1e-15)
    # also over two ticks: the hidden part of the forward state has no gradient
    two = lambda m: lambda u: m.state(m.step(m.step(m.init(x), u, a_ext), u, a_ext)).v  # noqa: E731

    def surrogate(u):
        reached_hosts, middle = jax.lax.stop_gradient(rotors.step(rotors.init(x), u, a_ext)), simple.step(x, u, a_ext)
        shift = jax.tree.map(lambda value, b: value + b - jax.lax.stop_gradient(b), rotors.state(reached_hosts), middle)
        return simple.step(shift, u, a_ext).v

    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-13),
        *jax.jit(lambda u: (jax.jacobian(two(model))(u), jax.jacobian(surrogate)(u)))(u),
    )


def test_straight_through_refuses_different_ticks():
    with pytest.raises(ValueError, match=r"forward\.dt = 0\.02 s, backward\.dt = 0\.01 s"):
        StraightThrough(PointMass(0.02), PointMass(0.01))


def test_hybrid_accepts_any_base(key):
    hybrid = Hybrid(LinearDragQuadrotor.of(small(), 0.02), lambda x, u: jnp.array([0.0, 0.0, 3.0]))
    x = State.at(jnp.zeros(3))
    plain = hybrid.base.step(hybrid.init(x), Command.hover(), jnp.array([0.0, 0.0, 3.0]))
    np.testing.assert_allclose(hybrid.state(hybrid.step(hybrid.init(x), Command.hover(), jnp.zeros(3))).v, plain.x.v)
    assert hybrid.dt == 0.02


def test_new_values_do_not_retrace(key):
    traces = 0

    @jax.jit
    def step(model, x, u, a_ext):
        nonlocal traces
        traces += 1
        return model.step(model.init(x), u, a_ext)

    heavy = jax.tree.map(lambda leaf: 1.1 * leaf, small())
    for vehicle in (small(), heavy):
        step(LinearDragQuadrotor.of(vehicle, 0.02), random_state(key), random_command(key), jnp.ones(3))
    assert traces == 1


def test_disturbances():
    x, a = State.at(jnp.zeros(3)), jnp.array([0.5, 0.5, 0.5])
    np.testing.assert_array_equal(Constant(a)(jnp.array(7.0), x).push, a)
    reversing = Reversing(a, jnp.array(15.0))
    signs = [float(reversing(jnp.array(t), x).push[0]) for t in (0.0, 14.99, 15.01, 29.9, 30.1)]
    assert signs == [0.5, 0.5, -0.5, -0.5, 0.5]
    with pytest.raises(ValueError, match=r"Reversing\.period"):
        Reversing(a, jnp.array(0.0))
