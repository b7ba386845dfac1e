"""Physical laws of a rotor-level model, for both vehicles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import call, random_command, random_state, replace_fields
from retrim.physics import Command, ExternalEffects, LinearDragQuadrotor, State, large, small, so3
from retrim.physics.substep import RotorState

VEHICLES = {"small": small, "large": large}


@pytest.fixture(params=list(VEHICLES))
def exact(request):
    """Return the model without a thrust error and without drag."""
    model = LinearDragQuadrotor.of(VEHICLES[request.param](), 0.02, thrust_error=0.0)
    return replace_fields(model, drag=jnp.zeros(3))


def fly_once(model, s, u, seconds, a_ext=None):
    a_ext = jnp.zeros(3) if a_ext is None else a_ext
    for _ in range(round(seconds / model.dt)):
        s = call(model.step, s, u, a_ext)
    return s


def test_hover_balance(exact):
    s = fly_once(exact, exact.init(State.at(jnp.zeros(3))), Command.hover(), 2.0)
    np.testing.assert_allclose(s.x.p, 0.0, atol=1e-10)
    np.testing.assert_allclose(s.x.R, np.eye(3), atol=1e-12)
    force, torque = exact.wrench(s, s.motors, exact.vehicle.thrust_coefficient * s.motors**2, jnp.zeros(3))
    np.testing.assert_allclose(force, [0, 0, float(exact.vehicle.mass) * 9.81], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(torque, 0.0, atol=1e-12)


def test_thrust_error_gives_stated_acceleration():
    model = replace_fields(LinearDragQuadrotor.of(small(), 0.02, thrust_error=0.035), drag=jnp.zeros(3))
    s = fly_once(model, model.init(State.at(jnp.zeros(3))), Command.hover(), 1.0)
    assert s.x.v[2] == pytest.approx(0.035 * 9.81 * 1.0, rel=1e-6)


def test_mixer_inverts_wrench(exact, key):
    force, torque = jnp.array(5.0), 1e-3 * random.normal(key, (3,))
    thrusts = exact.mix(force, torque)
    found_force, found_torque = exact.wrench(exact.init(State.at(jnp.zeros(3))), jnp.zeros(4), thrusts, jnp.zeros(3))
    np.testing.assert_allclose(found_force[2], force, rtol=1e-12)
    np.testing.assert_allclose(found_torque, torque, atol=1e-14)


def test_torque_of_each_rotor_follows_from_position(exact):
    """Front-right, back-left, back-right, front-left; torque = r x f in a forward-left-up frame."""
    ax, ay = (float(a) for a in exact.vehicle.arm)
    places = [(ax, -ay), (-ax, ay), (-ax, -ay), (ax, ay)]
    for i, (x, y) in enumerate(places):
        _, torque = exact.wrench(exact.init(State.at(jnp.zeros(3))), jnp.zeros(4), jnp.eye(4)[i], jnp.zeros(3))
        np.testing.assert_allclose(torque[:2], np.cross([x, y, 0], [0, 0, 1])[:2], atol=1e-12)
        assert np.sign(torque[2]) == (-1 if i < 2 else 1)


@jax.jit
def rates_under(model, u):
    """Return the body rates after each millisecond of a command."""

    def step(s, _):
        s = model.substep(s, u, ExternalEffects.calm(jnp.dtype(float)))
        return s, s.omega

    return lax.scan(step, model.init(State.at(jnp.zeros(3))), length=1500)[1]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rate_step_response(exact, axis):
    """Rates reach 63 % within 150 ms (yaw 300 ms), overshoot by less than 25 %, and settle on the command."""
    u = Command(jnp.array(9.81), 1.0 * jnp.eye(3)[axis])
    rates = np.asarray(rates_under(exact, u))[:, axis]
    assert rates[300 if axis == 2 else 150] > 0.63
    assert max(rates) < 1.25
    assert rates[-1] == pytest.approx(1.0, abs=0.03)


def test_mirror_symmetry(exact, key):
    """If start and command are mirrored in y, the flight is mirrored."""
    M = jnp.diag(jnp.array([1.0, -1.0, 1.0]))
    x, u = random_state(key, 0.3), random_command(key)
    mirror = State(M @ x.p, M @ x.R @ M, M @ x.v)
    s = fly_once(exact, exact.init(x), u, 0.2)
    t = fly_once(exact, exact.init(mirror), Command(u.c, -M @ u.omega), 0.2)
    np.testing.assert_allclose(t.x.p, M @ s.x.p, atol=1e-10)
    np.testing.assert_allclose(t.x.R, M @ s.x.R @ M, atol=1e-10)


def test_drag_dissipates_energy_and_ballistic_flight_conserves_it():
    model = LinearDragQuadrotor.of(small(), 0.02)
    v = jnp.array([3.0, -2.0, 1.0])
    x, zero = State(jnp.zeros(3), so3.exp(jnp.array([0.3, 0.2, 0.1])), v), jnp.zeros(3)
    s = RotorState(x, zero, jnp.zeros(4), zero, zero)
    force, _ = model.wrench(s, model.vehicle.hover_speed * jnp.ones(4), jnp.zeros(4), jnp.zeros(3))
    power = (s.x.R @ force) @ v
    assert power < 0.0
    assert power == pytest.approx(-float(model.vehicle.mass) * float(model.drag @ (s.x.R.T @ v) ** 2), rel=1e-12)


def test_commands_are_limited(exact):
    wild = Command(jnp.array(1e4), jnp.array([1e3, 0.0, 0.0]))
    s = fly_once(exact, exact.init(State.at(jnp.zeros(3))), wild, 0.5)
    vehicle = exact.vehicle
    thrusts = vehicle.thrust_coefficient * s.motors**2
    assert float(jnp.sum(thrusts)) <= float(vehicle.thrust_max) * (1 + 1e-9)
    assert float(jnp.max(jnp.abs(s.omega))) < 1.5 * float(vehicle.omega_max[0])


def test_gradients_are_finite(exact, key):
    slopes = jax.jit(jax.jacobian(lambda u, x: exact.step(exact.init(x), u, jnp.zeros(3)).x.vector(), (0, 1)))
    for k in random.split(key, 3):
        J = slopes(random_command(k), random_state(k))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(J))


def test_lift_and_project(exact, key):
    x, y = random_state(key), random_state(random.key(7))
    s = exact.init(x)
    jax.tree.map(np.testing.assert_array_equal, exact.state(s), x)
    jax.tree.map(np.testing.assert_array_equal, exact.state(exact.with_state(s, y)), y)


@pytest.mark.parametrize("dt", [0.0005, 0.0205, 0.0])
def test_tick_must_be_whole_milliseconds(dt):
    with pytest.raises(ValueError, match=r"LinearDragQuadrotor\.dt"):
        LinearDragQuadrotor.of(small(), dt)


@pytest.mark.parametrize("make", VEHICLES.values(), ids=VEHICLES)
def test_vehicles(make):
    vehicle = make()
    assert float(vehicle.mass) * 9.81 < float(vehicle.thrust_max)
    assert float(vehicle.command_min.c) < 9.81 < float(vehicle.command_max.c)
    assert 4 * float(vehicle.thrust_coefficient) * float(vehicle.hover_speed) ** 2 == pytest.approx(
        float(vehicle.mass) * 9.81
    )


def test_vehicles_can_be_traced():
    """A mass may be mapped over, or differentiated."""
    hover = lambda mass: replace_fields(small(), mass=mass).hover_speed  # noqa: E731
    np.testing.assert_allclose(jax.vmap(hover)(jnp.array([0.19, 0.76]))[1], 2 * hover(jnp.array(0.19)))
    assert jax.grad(hover)(jnp.array(0.19)) > 0


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("mass", -1.0, r"Vehicle\.mass = -1\.0 must be positive"),
        ("motor_tau", float("nan"), r"Vehicle\.motor_tau = nan"),
        ("thrust_max", 1.0, r"cannot lift its weight, 1\.86 N"),
    ],
)
def test_invalid_vehicles_are_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        replace_fields(small(), **{field: jnp.array(value)})
