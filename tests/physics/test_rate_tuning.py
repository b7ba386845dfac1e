"""The simulated rate loop: settings of the platform if they suit the vehicle, otherwise derived settings."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from retrim.config import PRESETS, VehicleSpec
from retrim.config.vehicles import PUBLISHED, make_vehicle
from retrim.physics import Command, State
from retrim.physics.bem import BemQuadrotor
from retrim.physics.betaflight import Betaflight
from retrim.physics.effects import ExternalEffects
from retrim.physics.rate_tuning import Gains, is_damped, tune
from retrim.physics.rotors import LinearDragQuadrotor
from retrim.physics.step_response import step_responses
from retrim_paper.conditions import conditions

SIZES = {
    "0.035 kg": (0.035, (1.7e-5, 1.7e-5, 2.9e-5), 0.0325, 0.6, 1.9),
    "0.25 kg": (0.25, (2e-4, 2.2e-4, 3.5e-4), 0.05, 9.0, 3.0),
    "2 kg": (2.0, (0.022, 0.024, 0.04), 0.16, 45.0, 10.0),
    "4 kg": (4.0, (0.08, 0.08, 0.14), 0.23, 80.0, 15.0),
    "10 kg": (10.0, (0.45, 0.45, 0.8), 0.4, 220.0, 28.0),
}


def size_of(name, motor_tau):
    mass, inertia, arm, thrust, inches = SIZES[name]
    return VehicleSpec(
        name="sized", mass=mass, inertia=inertia, arm=(arm, arm), thrust_max=thrust, rates_max=(4.0, 4.0, 2.0),
        motor_tau=motor_tau, propeller_diameter=inches,
    ).build()  # fmt: skip


@eqx.filter_jit
def fly_once(model, axis):
    """Return the body rate under a step of 1 rad/s at hover thrust, tick by tick."""
    expected = jnp.zeros(3).at[axis].set(1.0)

    def tick(s, _):
        s = model.substep(s, Command(jnp.array(9.80665), expected), ExternalEffects.calm(jnp.zeros(()).dtype))
        return s, model.rotor_state(s).omega[axis]

    return lax.scan(tick, model.init(State.at(jnp.array([0.0, 0.0, 1.0]))), length=600)[1]


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_vehicles_use_platform_settings(name):
    loop = BemQuadrotor.of(PUBLISHED[name](), 0.02).loop
    assert eqx.tree_equal(loop, Betaflight.of(loop.thrust_map))
    simple = LinearDragQuadrotor.of(PUBLISHED[name](), 0.02).loop
    np.testing.assert_array_equal([simple.kp, simple.ki, simple.kd], [[25, 25, 12.5], [37] * 3, [0.05, 0.05, 0.0]])


def test_gauntlet_vehicles_use_platform_settings_at_hover():
    vehicles = [flight.vehicle for flight in conditions(PRESETS["hover/retrim"]).values() if flight.vehicle is not None]
    assert len(vehicles) >= 6
    for vehicle in vehicles:
        for error in (0.035, -0.2, 0.2):
            loop = BemQuadrotor.of(make_vehicle(vehicle), 0.02, thrust_error=error).loop
            assert eqx.tree_equal(loop, Betaflight.of(loop.thrust_map))


@pytest.mark.parametrize("motor_tau", [0.02, 0.05, 0.1])
@pytest.mark.parametrize("name", SIZES)
def test_simulated_step_response_equals_prediction(name, motor_tau):
    """The overshoot is below 40 % from 35 g to 10 kg; with the platform's settings it is up to 200 %."""
    vehicle = size_of(name, motor_tau)
    model = BemQuadrotor.of(vehicle, 0.02)
    for axis, prediction in enumerate(step_responses(vehicle)):
        rate = np.asarray(fly_once(model, axis))
        assert rate.max() - 1.0 < 0.4
        assert prediction.overshoot == pytest.approx(max(0.0, rate.max() - 1.0), abs=0.1)
        assert prediction.rise == pytest.approx(1e-3 * np.argmax(rate >= 0.632), rel=0.05, abs=0.004)


@pytest.mark.parametrize("motor_tau", [0.02, 0.05, 0.1])
def test_simple_plant_has_little_overshoot(motor_tau):
    model = LinearDragQuadrotor.of(size_of("4 kg", motor_tau), 0.02)
    for axis in range(3):
        assert np.asarray(fly_once(model, axis)).max() < 1.4


def poles(gains, tau, lead=0.0):
    a, i, b = (np.asarray(part)[0] for part in gains)
    return np.roots([tau, 1.0 + b + a * lead, a + i * lead, i])


@pytest.mark.parametrize("motor_tau", [0.01, 0.05, 0.1, 0.3])
def test_derived_gains_have_stated_damping(motor_tau):
    plain = Gains(jnp.full(3, 20.0), jnp.full(3, 300.0), jnp.full(3, 0.2))
    own = tune(plain, jnp.array(motor_tau))
    without_integral = Gains(own.a, jnp.zeros(3), own.b)
    result = poles(without_integral, motor_tau)
    oscillating = result[np.abs(result.imag) > 1e-6]
    np.testing.assert_allclose(-oscillating.real / np.abs(oscillating), 0.8, rtol=1e-6)
    assert np.all(poles(own, motor_tau).real < -0.02 / motor_tau)
    assert np.all(is_damped(own, jnp.zeros(3), jnp.array(motor_tau)))


def test_unstable_loop_has_no_damping():
    rng = np.random.default_rng(3)
    stable = []
    for _ in range(300):
        a, i, b, lead = np.exp(rng.uniform(np.log([1.0, 1.0, 0.01, 0.001]), np.log([300.0, 5000.0, 3.0, 0.5])))
        gains, tau = Gains(*(jnp.full(3, x) for x in (a, i, b))), rng.uniform(0.01, 0.3)
        stable.append(bool(np.all(poles(gains, tau, lead).real < 0.0)))
        if np.asarray(is_damped(gains, jnp.full(3, lead), jnp.array(tau)))[0]:
            assert stable[-1]
    assert 50 < sum(stable) < 280


def test_step_response_includes_thrust_saturation():
    """With 0.01 of the arm, the same gains saturate."""
    weak = dataclasses.replace(size_of("4 kg", 0.1), inertia=200.0 * jnp.array([0.08, 0.08, 0.14]))
    assert step_responses(weak)[0].rise > 2.0 * step_responses(size_of("4 kg", 0.1))[0].rise
