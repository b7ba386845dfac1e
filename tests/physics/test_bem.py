"""Physical laws of the blade-element plant, for all vehicles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import random_command, random_state, replace_fields
from retrim.physics import (
    BemQuadrotor,
    Command,
    ExternalEffects,
    Hybrid,
    PointMass,
    RotorState,
    State,
    StraightThrough,
    betaflight,
    kingfisher,
    large,
    small,
    so3,
)
from retrim.physics import bem as bem_module
from retrim.physics import (
    substep as highrate,
)
from retrim.physics.propeller import BladeForces, Inflow
from retrim.physics.substep import SIGNS, SUBSTEP, rigid_body

VEHICLES = {"small": small, "large": large, "kingfisher": kingfisher}
G, ZERO = 9.81, np.zeros(3)


def strongly_typed(tree):
    """Return the tree without weak types, so that one program serves all tests."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), tree, is_leaf=lambda node: isinstance(node, list))


@pytest.fixture(params=list(VEHICLES))
def bem(request):
    """Return the model of each vehicle, without a thrust error."""
    return strongly_typed(BemQuadrotor.of(VEHICLES[request.param](), 0.02, thrust_error=0.0))


def effects(**values):
    return ExternalEffects.of(jnp.dtype(float), **strongly_typed(values))


def command(c=G, omega=ZERO):
    return Command(*strongly_typed((c, omega)))


def state(v=ZERO, rotation=ZERO):
    p, rotation, v = strongly_typed((ZERO, rotation, v))
    return State(p, so3.exp(rotation), v)


def body(x, motors, omega=ZERO):
    return RotorState(x, *strongly_typed((omega, motors, ZERO, ZERO)))


@jax.jit
def start(model, x):
    return strongly_typed(model.init(x))


@jax.jit
def path(model, s, u, effects):
    """Return the states of every millisecond of two seconds."""

    def millisecond(s, _):
        after = model.substep(s, u, effects)
        return after, after

    return lax.scan(millisecond, s, length=2000)[1]


def at(path, ms):
    return jax.tree.map(lambda leaf: leaf[ms - 1], path)


@jax.jit
def loads(model, b, motors, effects):
    """Return steady loads at rotor speeds ``motors``, and those of the blades."""
    above = jax.tree.map(lambda leaf: jnp.full(4, leaf), Inflow.above(motors.dtype))
    has_settled = lax.fori_loop(0, 9, lambda _, inflow: model.rotors(b, motors, inflow, effects.wind)[1], above)
    blades, _ = model.rotors(b, motors, has_settled, effects.wind)
    return model.loads(b, motors, blades, effects), blades


def hover_state(model, x=None, **options):
    motors = start(model, state()).body.motors
    return loads(model, body(x or state(), motors), motors, effects(**options))[0]


# ---- balance


def test_hover_balance(bem):
    p = path(bem, start(bem, state()), command(), effects())
    np.testing.assert_allclose(p.body.x.p, 0.0, atol=1e-9)
    np.testing.assert_allclose(p.body.x.R[-1], np.eye(3), atol=1e-12)
    force, torque = hover_state(bem)
    np.testing.assert_allclose(force, [0, 0, float(bem.vehicle.mass) * G], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(torque, 0.0, atol=1e-12)


@pytest.mark.parametrize("error", [-0.035, 0.035])
def test_thrust_error_gives_stated_acceleration(bem, error):
    wrong = strongly_typed(BemQuadrotor.of(bem.vehicle, 0.02, thrust_error=error))
    assert float(hover_state(wrong).force[2] / bem.vehicle.mass) == pytest.approx((1 + error) * G, rel=1e-9)
    v = path(wrong, start(wrong, state()), command(), effects()).body.x.v
    assert float(v[19, 2]) == pytest.approx(error * G * 0.02, rel=0.02)


def test_mirror_symmetry(bem, key):
    """If start, command and wind are mirrored in y, the flight is mirrored."""
    M = jnp.diag(jnp.array([1.0, -1.0, 1.0]))
    x, u, wind = random_state(key, 0.3), random_command(key), jnp.array([1.0, 2.0, 0.5])
    mirror = jax.jit(lambda x: State(M @ x.p, M @ x.R @ M, M @ x.v))(x)
    s = at(path(bem, start(bem, x), u, effects(wind=wind)), 300).body.x
    t = at(path(bem, start(bem, mirror), Command(u.c, -M @ u.omega), effects(wind=M @ wind)), 300).body.x
    np.testing.assert_allclose(t.p, M @ s.p, atol=1e-10)
    np.testing.assert_allclose(t.R, M @ s.R @ M, atol=1e-10)


def test_only_airspeed_matters(bem):
    v, rotation = jnp.array([2.0, -1.0, 0.5]), [0.1, 0.2, 0.3]
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12),
        hover_state(bem, state(v, rotation)),
        hover_state(bem, state(ZERO, rotation), wind=-v),
    )
    u, s = command(10.0, [1.0, 0.5, -0.5]), start(bem, state(v, rotation))
    flying = path(bem, s, u, effects()).body.x
    hold = path(bem, bem.with_state(s, state(ZERO, rotation)), u, effects(wind=-v)).body.x
    t = SUBSTEP * np.arange(1, 301)[:, None]
    np.testing.assert_allclose(flying.p[:300] - hold.p[:300], t * np.asarray(v), atol=1e-10)
    np.testing.assert_allclose(flying.R[:300], hold.R[:300], atol=1e-10)


def test_terminal_velocity(bem):
    """A fall with idling rotors approaches the speed at which drag and idle thrust balance the weight."""
    s, speeds = start(bem, state()), []
    for _ in range(5):
        s = at(path(bem, s, command(0.0), effects()), 2000)
        speeds.append(-float(s.body.x.v[2]))
    weight, idling = float(bem.vehicle.mass) * G, s.body.motors
    lift = lambda v: float(loads(bem, body(state([0.0, 0.0, -v]), idling), idling, effects())[0].force[2])  # noqa: E731
    assert lift(0.999 * speeds[-1]) < weight < lift(1.001 * speeds[-1])
    assert 8.0 < speeds[0] < speeds[-1] < 20.0


# ---- air


def test_air_dissipates_energy(bem, key):
    """Body drag and in-plane forces oppose the airflow, with or without rotation, and account for the whole power."""
    for k in random.split(key, 20):
        x, omega = random_state(k, 5.0), np.asarray(random.normal(k, (3,)))
        b, through = body(x, 1000.0 * np.ones(4), omega), np.asarray(x.R).T @ np.asarray(x.v)
        drag, in_plane, (force, torque) = jax.tree.map(np.asarray, dissipative_loads(bem, b))
        of_body = drag @ through
        hubs = through + np.cross(omega, bem.places())
        of_rotors = -bem_module.IN_PLANE_GAIN * in_plane @ np.linalg.norm(hubs[:, :2], axis=1)
        assert of_body < 0.0
        assert (in_plane > 0).all()
        assert force @ through + torque @ omega == pytest.approx(of_body + of_rotors, rel=1e-6)


@jax.jit
def dissipative_loads(model, b):
    """Return drag of the body, in-plane forces, and the loads of these two only."""
    _, blades = loads(model, b, b.motors, effects())
    alone = blades._replace(thrust=jnp.zeros(4), torque=jnp.zeros(4))
    return model.body_drag(b, jnp.zeros(3)), blades.in_plane, model.loads(b, b.motors, alone, effects())


# ---- rates, rotors, load


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rate_step_response(bem, axis):
    """Rates reach 63 % in 60 ms (yaw 200 ms) and overshoot by less than 35 %; the other rates are constant."""
    rates = path(bem, start(bem, state()), command(G, np.eye(3)[axis]), effects()).body.omega
    assert rates[200 if axis == 2 else 60, axis] > 0.63
    assert rates[:, axis].max() < 1.35
    assert rates[-1, axis] == pytest.approx(1.0, abs=0.15)
    assert np.abs(np.delete(rates, axis, axis=1)).max() < 0.05


def test_commands_are_limited(bem):
    vehicle = bem.vehicle
    p = path(bem, start(bem, state()), command(1e4, [1e3, 0.0, 0.0]), effects()).body
    assert (p.motors <= vehicle.motor_max).all()
    assert (p.motors >= vehicle.motor_min).all()
    assert jnp.abs(p.omega[:, 0]).max() < 1.5 * vehicle.omega_max[0]
    full = path(bem, start(bem, state()), command(1e4), effects()).body.motors[-1]
    # the controllers of the small vehicle stay below it
    expected = jnp.sqrt(vehicle.thrust_max / (4.0 * bem.loop.thrust_map))
    np.testing.assert_allclose(full, min(expected, vehicle.esc.speed(jnp.array(1.0))), rtol=1e-6)


@pytest.mark.parametrize("rotor", range(4))
def test_weak_rotor_lowers_its_corner(bem, rotor):
    gain = np.ones(4)
    gain[rotor] = 0.8
    force, torque = hover_state(bem, gain=gain)
    np.testing.assert_array_equal(np.sign(torque), -np.array(SIGNS)[:, rotor])
    np.testing.assert_allclose(force[2], 0.95 * float(bem.vehicle.mass) * G)
    np.testing.assert_allclose(torque[0], 0.2 * force[2] / 3.8 / bem_module.FRAME_FACTOR * bem.places()[rotor, 1] * -1)


def test_payload_slows_climb(bem):
    m, dm = float(bem.vehicle.mass), 0.07
    s = path(bem, start(bem, state()), command(15.0), effects())
    gain = [path(bem, at(s, 20), command(15.0), effects(mass=k)).body.x.v[0] - s.body.x.v[19] for k in (0.0, dm)]
    thrusts = [g[2] / SUBSTEP + G for g in gain]
    assert float(thrusts[1] / thrusts[0]) == pytest.approx(m / (m + dm), rel=1e-9)


def test_angular_momentum_is_conserved(bem):
    """Without rotor forces, gyroscopic torque and yaw reaction only exchange momentum between body and rotors."""
    vehicle, yaw = bem.vehicle, jnp.array(SIGNS[2], dtype=float)
    none = BladeForces(*(jnp.zeros(4) for _ in range(3)))
    still = replace_fields(bem, vehicle=replace_fields(vehicle, drag_area=1e-12 * jnp.ones(3)))

    def momentum(b):
        rotors = -vehicle.rotor_inertia * jnp.sum(yaw * b.motors)  # the front-right rotor turns towards +z
        return b.x.R @ (vehicle.inertia * b.omega + jnp.array([0.0, 0.0, 1.0]) * rotors)

    def millisecond(b, i):
        motors = b.motors + jnp.array([30.0, 10.0, -2.0, 5.0])
        force, torque = still.loads(b, motors, none, effects())
        return rigid_body(b, motors, b.integral, force, torque, vehicle.mass, vehicle.inertia, b.integral), momentum(b)

    b = body(state(), [900.0, 1000.0, 1100.0, 1000.0], [1.0, -0.5, 0.3])
    L = jax.jit(lambda b: lax.scan(millisecond, b, length=100))(b)[1]
    scale = float(vehicle.rotor_inertia) * 4000.0  # gained by the rotors
    np.testing.assert_allclose(L, np.tile(L[0], (100, 1)), atol=0.05 * scale)
    gyro = still.loads(b, b.motors, none, effects()).torque
    assert float(gyro @ b.omega) == pytest.approx(0.0, abs=1e-15)
    assert float(jnp.linalg.norm(gyro)) > 0.0
    smooth_start = still.loads(b, b.motors + jnp.array([9.0, 0.0, 0.0, 0.0]), none, effects()).torque - gyro
    assert float(smooth_start[2]) < 0.0


# ---- as a model


def test_loads_can_be_constant_over_a_millisecond(monkeypatch):
    """Half the step changes a 10 s hover in wind, from half a metre away, by less than a millimetre."""
    model = strongly_typed(BemQuadrotor.of(small(), 0.02))
    windy = effects(wind=[2.0, 1.0, 0.0])

    def tick(s, _, *, n):
        x = model.state(s)
        a = jnp.array([0.0, 0.0, G]) - 4.0 * x.p - 3.0 * x.v
        up = x.R.T @ a
        u = Command(up[2], jnp.array([-8.0 * up[1], 8.0 * up[0], 0.0]) / jnp.linalg.norm(a))
        return lax.fori_loop(0, n, lambda _, s: model.substep(s, u, windy), s), x.p

    def fly_once(n):
        x0 = State(jnp.array([0.3, -0.3, 0.3]), jnp.eye(3), jnp.zeros(3))
        return jax.jit(lambda s: lax.scan(lambda s, i: tick(s, i, n=n), s, length=500)[1])(start(model, x0))

    coarse = fly_once(20)
    for module in (bem_module, betaflight, highrate):
        monkeypatch.setattr(module, "SUBSTEP", 0.5e-3)
    fine = fly_once(40)
    assert jnp.abs(coarse[-1]).max() < 0.2  # it hovers
    assert 0.0 < jnp.abs(coarse - fine).max() < 1e-3


@jax.jit
def tick(model, s, x, u, weights):
    """One tick as a number, and its gradient backward through time."""

    def number(x, u):
        return weights @ model.state(model.step(model.with_state(s, x), u, jnp.zeros(3))).vector()

    return jax.value_and_grad(number, argnums=(0, 1))(x, u)


def test_gradients_equal_finite_differences(bem, key):
    """Gradients are checked at high and low speed, in all attitudes, from idle to full thrust, and at rest."""
    vehicle = bem.vehicle
    for k in random.split(key, 8):
        x, weights = random_state(k, 6.0), random.normal(k, (15,))
        u = command(random.uniform(k) * vehicle.command_max.c, random.uniform(k, (3,), minval=-1.0) * vehicle.omega_max)
        s, d = start(bem, x), 1e-5 * random.normal(k, (3,))
        _, (dx, du) = tick(bem, s, x, u, weights)
        high, low = (
            tick(bem, s, replace_fields(x, v=x.v + e), Command(u.c + e[0], u.omega + e), weights)[0] for e in (d, -d)
        )
        slope = (dx.v + du.omega) @ d + du.c * d[0]
        assert float(high - low) / 2.0 == pytest.approx(float(slope), rel=1e-4, abs=1e-10)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((dx, du)))
    after = tick(bem, start(bem, state()), state(), command(), weights)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))


def test_hybrid_and_straight_through(key):
    """The value is that of the blade-element model with a residual, and the gradient that of Eq. (1)."""
    x, u, push = random_state(key, 0.3), random_command(key), jnp.array([0.5, 0.0, -1.0])
    model, weights = strongly_typed(BemQuadrotor.of(small(), 0.02)), jnp.arange(15.0)
    s = start(model, x)

    def slope(model, s):
        return jax.value_and_grad(lambda u: weights @ model.state(model.step(s, u, push)).vector())(u)

    both = StraightThrough(Hybrid(model, lambda x, u: 2.0 * x.v), PointMass(0.02))
    value, gradient = jax.jit(lambda s: slope(both, s))(s)
    _, expected = jax.jit(lambda x: slope(both.backward, x))(x)
    flight = at(path(model, s, u, effects(push=push + 2.0 * x.v)), 20)
    assert float(value) == pytest.approx(float(weights @ flight.body.x.vector()), rel=1e-12)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), gradient, expected)


@pytest.mark.parametrize("dt", [0.0005, 0.0205, 0.0])
def test_tick_must_be_whole_milliseconds(dt):
    with pytest.raises(ValueError, match=r"BemQuadrotor\.dt"):
        BemQuadrotor.of(small(), dt)


@pytest.mark.parametrize("name", ["small", "large"])
def test_integral_removes_steady_rate_error_of_weak_rotor(name):
    """With the firmware's scaling, the integral term holds the commanded rates against a constant torque."""
    bem = strongly_typed(BemQuadrotor.of(VEHICLES[name](), 0.02))
    weak = effects(gain=[0.9, 1.0, 1.0, 1.0])
    rates = path(bem, start(bem, state()), command(), weak).body.omega
    assert np.abs(rates[:200]).max() > 0.05  # the torque has an effect
    np.testing.assert_allclose(rates[-1], 0.0, atol=0.01)
