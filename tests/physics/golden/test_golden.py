"""Golden numbers of the Agilicious simulator's other models, damping, speed controllers, and weights."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from helpers import replace_fields
from retrim.physics import (
    BemQuadrotor,
    Command,
    ExternalEffects,
    LinearDragQuadrotor,
    RotorState,
    State,
    kingfisher,
    large,
    small,
    with_payload,
)
from retrim.physics.propeller import BladeForces, Inflow
from retrim.physics.substep import rigid_body

BEM, SIMPLE = (json.loads((Path(__file__).parent / f"{name}.json").read_text()) for name in ("bem", "simple_models"))
SLOW = (0, 1, 2, 6)  # without body rates, up to 3 m/s: the omitted flapping has no visible effect there


@pytest.fixture(params=range(6))
def case(request):
    return {name: np.array(value, dtype=float) for name, value in SIMPLE["cases"][request.param].items()}


def rotation(q):
    w, (x, y, z) = q[0], q[1:]
    hat = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * hat + 2 * hat @ hat


def state(case):
    case = {name: np.array(value, dtype=float) for name, value in case.items()}
    x = State(jnp.zeros(3), jnp.asarray(rotation(case["q_wxyz"])), jnp.asarray(case["v_W"]))
    return RotorState(x, jnp.asarray(case["w_B"]), jnp.asarray(case["mot"]), jnp.zeros(3), jnp.zeros(3))


def plants():
    """Return the kingfisher with the arms of the golden file, without drag: by blade elements and by coefficients."""
    vehicle = replace_fields(
        kingfisher(), arm=jnp.abs(jnp.array(SIMPLE["arms"][0][:2])), torque_ratio=jnp.array(SIMPLE["kappa"])
    )
    assert (float(vehicle.mass), vehicle.inertia.tolist()) == (SIMPLE["mass"], SIMPLE["J"])
    assert float(vehicle.thrust_coefficient) == SIMPLE["thrust_coefficient"][0]
    bem = BemQuadrotor.of(replace_fields(vehicle, drag_area=1e-12 * jnp.ones(3)), 0.02)
    return bem, replace_fields(LinearDragQuadrotor.of(vehicle, 0.02, thrust_error=0.0), drag=jnp.zeros(3))


def test_quadratic_rotors_and_step(case):
    """Position is the mean of both Euler steps; the published attitude is renormalised differently."""
    _, rotors = plants()
    vehicle, s = rotors.vehicle, state(case)
    force, torque = rotors.wrench(s, s.motors, vehicle.thrust_coefficient * s.motors**2, jnp.zeros(3))
    gravity = np.array([0.0, 0.0, -SIMPLE["G"]])
    np.testing.assert_allclose(s.x.R @ force / vehicle.mass + gravity, case["tts_dvel"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(torque / vehicle.inertia, case["tts_dome"], rtol=1e-9, atol=1e-9)
    lighter = jnp.array([0.0, 0.0, 9.81 - SIMPLE["G"]])
    after = rigid_body(s, s.motors, s.integral, force, torque, vehicle.mass, vehicle.inertia, lighter)
    np.testing.assert_allclose(after.x.v, case["sym_vel"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(after.omega, case["sym_ome"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(after.x.p, 0.5 * (case["euler_pos"] + case["sym_pos"]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(after.x.R, rotation(case["sym_att"]), atol=1e-5)


def test_free_rotation(case):
    vehicle, s, zero = kingfisher(), state(case), jnp.zeros(3)
    after = rigid_body(s, s.motors, zero, zero, zero, vehicle.mass, vehicle.inertia, zero)
    np.testing.assert_allclose(after.omega_dot, case["rb_dome"], rtol=1e-9, atol=1e-12)


def test_motors(case, monkeypatch):
    _, rotors = plants()
    monkeypatch.setattr(LinearDragQuadrotor, "rate_loop", lambda self, s, u: (jnp.asarray(case["motdes"]), s.integral))
    after = rotors.substep(state(case), Command.hover(), ExternalEffects.calm(jnp.dtype(float)))
    np.testing.assert_allclose(after.motors, case["rk4_mot"], rtol=1e-9)


def test_body_drag(case):
    """The published numbers lack the division by the mass."""
    s = state(case)
    force = BemQuadrotor.of(kingfisher(), 0.02).body_drag(s, jnp.zeros(3))
    np.testing.assert_allclose(s.x.R @ force, case["bodydrag_dvel"], rtol=1e-9, atol=1e-12)


@jax.jit
def acceleration(model, s, blades):
    calm = ExternalEffects.calm(jnp.dtype(float))
    above = jax.tree.map(lambda leaf: jnp.full(4, leaf), Inflow.above(s.motors.dtype))
    inflow = lax.fori_loop(0, 8, lambda _, inflow: model.rotors(s, s.motors, inflow, calm.wind)[1], above)
    ours, _ = model.rotors(s, s.motors, inflow, calm.wind)
    force = lambda blades: s.x.R @ model.loads(s, s.motors, blades, calm).force / model.vehicle.mass  # noqa: E731
    return force(ours), force(blades)


@pytest.mark.parametrize("index", SLOW)
def test_acceleration_of_blade_elements(index):
    case, (bem, _) = BEM["cases"][index], plants()
    T, H3, Q = (jnp.array(case[name], dtype=float) for name in ("thrust", "hforce", "torque"))
    golden = np.add(case["dvel"], [0.0, 0.0, BEM["G"]])
    ours, matrix = acceleration(bem, state(case), BladeForces(T, H3 / 3.0, Q))
    np.testing.assert_allclose(ours, golden, atol=0.5)
    np.testing.assert_allclose(matrix, golden, atol=0.01)


# The small quadrotor's numbers, like its propeller, are a proposal.
@pytest.mark.parametrize(("make", "edgewise", "axial"), [(kingfisher, 0.24, 0.37), (small, 0.33, 0.45)])
def test_damping(make, edgewise, axial):
    """Damping of the rotors only, at hover [1/s]: at 3 m/s edgewise, and climbing."""
    model = BemQuadrotor.of(make(), 0.02, thrust_error=0.0)
    model = replace_fields(model, vehicle=replace_fields(model.vehicle, drag_area=1e-12 * jnp.ones(3)))
    motors = jnp.sqrt(model.vehicle.mass * 9.81 / (4.0 * model.loop.thrust_map)) * jnp.ones(4)

    def at(*v):
        s = state({"q_wxyz": [1, 0, 0, 0], "v_W": v, "w_B": [0, 0, 0], "mot": motors})
        return acceleration(model, s, BladeForces(*3 * (motors,)))[0]

    assert -at(3.0, 0.0, 0.0)[0] / 3.0 == pytest.approx(edgewise, rel=0.1)
    assert at(0.0, 0.0, 0.0)[2] - at(0.0, 0.0, 1.0)[2] == pytest.approx(axial, rel=0.1)


@pytest.mark.parametrize("make", [small, large, kingfisher])
def test_speed_controllers(make):
    esc = make().esc
    throttle = jnp.linspace(0.0, 1.0, 21)
    np.testing.assert_allclose(esc.throttle(esc.speed(throttle)), throttle, atol=1e-12)
    assert (jnp.diff(esc.speed(throttle)) > 0).all()
    if make is small:
        assert float(esc.throttle(jnp.array(1515.58))) == pytest.approx(0.2334, abs=5e-5)
        assert 0.2334 * (2048 - float(esc.d_min)) + float(esc.d_min) == pytest.approx(562.3, abs=0.2)


def test_payload():
    assert float(with_payload(small(), 0.07).mass) == pytest.approx(0.26)
