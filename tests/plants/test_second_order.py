"""The plant of second order: a vehicle with a known command path."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import check_slope, random_command, stack_trees
from retrim import testing
from retrim.config import Scenario, VehicleSpec
from retrim.learn.stacking import stack
from retrim.physics import (
    ActuatorResponse,
    Command,
    Constant,
    ExternalEffects,
    Push,
    SecondOrderQuadrotor,
    State,
    small,
)
from retrim.plants import SensorModel, SimPlant

DT = 0.02
START = State.at(jnp.array([0.3, -0.2, 1.5]))
CALM = Constant(jnp.zeros(3))
SLOW = ActuatorResponse.of(0.06, jnp.array([0.1, 0.1, 0.3]), inverse_damping=2.0, thrust_gain=0.9)


def model(response=SLOW, dt=DT):
    vehicle = small()
    limits = (vehicle.command_min, vehicle.command_max)
    return SecondOrderQuadrotor(response, vehicle.mass, jnp.array(0.3), limits, dt)


def plant(response=SLOW, disturbance=CALM, **options):
    return SimPlant(model(response), disturbance, **options)


def second_order(times, lag, zeta):
    """Return the step response of a second-order system."""
    omega_n, root = 2.0 * zeta / lag, np.sqrt(complex(1.0 - zeta**2))
    swing = np.cos(omega_n * root * times) + zeta / root * np.sin(omega_n * root * times)
    return np.where(times > 0.0, 1.0 - np.real(np.exp(-zeta * omega_n * times) * swing), 0.0)


@pytest.mark.parametrize("delay", [0.0, 0.0125, 0.02, 0.0374, 0.1])
@pytest.mark.parametrize("zeta", [0.4, 0.7, 1.2])
def test_measured_rates_equal_analytical_step_response(delay, zeta):
    """Rates are exact if the command changes at a millisecond, and otherwise within the mean of one millisecond."""
    flying = plant(ActuatorResponse.of(0.03, 0.1, inverse_damping=1.0 / zeta), delay_s=delay)
    flying.reset(START)
    u = Command(jnp.array(9.81), jnp.array([1.0, -0.5, 0.3]))
    rates = np.array([flying.step(u)[0].omega for _ in range(30)])
    rise = second_order(DT * np.arange(1, 31) - delay, 0.1, zeta)
    whole = abs(1e3 * delay - round(1e3 * delay)) < 1e-9
    np.testing.assert_allclose(rates, rise[:, None] * np.asarray(u.omega), atol=1e-10 if whole else 1e-4)


def numpy_flight(response, us, delay, push, h=2e-4, gravity=9.81):
    """Simulate the same vehicle in NumPy, with steps so short that the integration rule hardly matters."""
    p, R, v, c, w, dw = np.array(START.p), np.eye(3), np.zeros(3), gravity, np.zeros(3), np.zeros(3)
    tau, kappa = np.asarray(response.rate_lag), np.asarray(response.inverse_damping)
    sigma, states = (0.5 * tau * kappa) ** 2, []
    for i in range(round(len(us) * DT / h)):
        k = int(np.floor(((i + 0.5) * h - delay) / DT))
        u = us[k] if k >= 0 else np.array([gravity, 0.0, 0.0, 0.0])
        c += h / float(response.thrust_lag) * (float(response.thrust_gain) * u[0] - c)
        dw += h * (u[1:] - w - tau * dw) / sigma
        w = w + h * dw
        angle = np.linalg.norm(w) * h
        axis = w / max(np.linalg.norm(w), 1e-12)
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        R = R @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
        a = c * R[:, 2] - np.array([0.0, 0.0, gravity]) - 0.3 * v + push
        v = v + h * a
        p = p + h * v
        if (i + 1) % round(DT / h) == 0:
            states.append(np.concatenate([p, R.ravel(), v]))
    return np.array(states)


@pytest.mark.parametrize("delay", [0.0, 0.034])
def test_flight_equals_numpy_simulation(delay):
    draw, push = np.random.default_rng(1), np.array([0.5, -0.3, 0.2])
    us = np.array([9.81, 0.0, 0.0, 0.0]) + draw.normal(size=(40, 4)) * np.array([2.0, 1.5, 1.5, 1.0])
    flying = plant(disturbance=Constant(jnp.array(push)), delay_s=delay)
    flying.reset(START)
    result = [flying.step(Command(jnp.array(u[0]), jnp.array(u[1:])))[0].x.vector() for u in us]
    np.testing.assert_allclose(result, numpy_flight(SLOW, us, delay, push), atol=2e-3)


def test_acceleration_is_measured_and_rotors_are_not():
    flying = plant(sensors=SensorModel.of(gyro=0.05, accelerometer=0.4))
    flying.reset(START)
    rows = [flying.step(Command.hover())[0] for _ in range(300)]
    assert rows[0].motor_speeds is None
    rates = np.stack([m.omega for m in rows])
    np.testing.assert_allclose(rates.std(axis=0), 0.05, rtol=0.15)  # no rotation
    assert np.stack([m.a for m in rows])[:, :2].std() == pytest.approx(0.4, rel=0.15)


def test_loads_weak_rotors_and_wind_act():
    def after(**effects):
        flying = plant(ActuatorResponse.of(), lambda t, x: ExternalEffects.of(x.p.dtype, **effects))
        flying.reset(START)
        return [flying.step(Command.hover())[0] for _ in range(3)][-1].a

    mass = float(small().mass)
    np.testing.assert_allclose(after(mass=jnp.array(mass))[2], -9.81 / 2, rtol=0.02)
    np.testing.assert_allclose(after(gain=jnp.array([0.6, 1.0, 1.0, 1.0]))[2], -0.981, rtol=0.02)
    np.testing.assert_allclose(after(wind=jnp.array([2.0, 0.0, 0.0]))[0], 0.6, rtol=0.05)


# ---- as a value


def fly(simulation, us):
    """Return rates and states of a flight, as a pure function."""

    def tick(s, row):
        k, u = row
        s = simulation.advance(s, u, k)
        return s, (simulation.true(s), simulation.model.body_rates(s.model))

    return lax.scan(tick, simulation.launch(START), (jnp.arange(us.c.shape[0]), us))[1]


def draw(n=15):
    return stack_trees([random_command(k) for k in random.split(random.key(0), n)])


VEHICLES = [(0.0, 0.015, 0.0, 1.0), (0.0374, 0.06, 2.0, 0.8), (0.06, 0.1, 1.0, 1.2), (0.08, 0.25, 0.5, 1.6)]


def simulations():
    for delay, lag, kappa, gain in VEHICLES:
        response = ActuatorResponse.of(0.03, lag, inverse_damping=kappa, thrust_gain=gain)
        yield plant(response, delay_s=delay).simulation


def test_batch_of_vehicles_equals_members():
    us = draw()
    together = eqx.filter_jit(lambda many: eqx.filter_vmap(lambda each: fly(each, us))(many))
    result = together(stack(list(simulations())))
    for i, each in enumerate(simulations()):
        alone = eqx.filter_jit(fly)(each, us)
        for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-10, atol=1e-12)


def test_new_vehicle_needs_no_compilation():
    """The plant compiles its launch and its tick once."""
    traces, once = [], 0

    def calm(t, x):
        traces.append(t)
        return jnp.zeros(3)

    disturbance = Push(calm)
    for delay, lag, kappa, gain in VEHICLES:
        response = ActuatorResponse.of(0.03, lag, inverse_damping=kappa, thrust_gain=gain)
        flying = plant(response, disturbance, delay_s=delay)
        flying.reset(START)
        for _ in range(3):
            flying.step(Command.hover())
        once = once or len(traces)
    assert len(traces) == once > 0


def test_gradients_equal_finite_differences():
    """The function is the last state; gradients are with respect to commands, start, delay and response."""
    us = draw(8)
    arguments, simulation = (jnp.array(0.033), SLOW, us), plant().simulation

    def cost(arguments):
        delay, response, us = arguments
        vehicle = dataclasses.replace(simulation.model, response=response)
        x, rates = fly(dataclasses.replace(simulation, delay=delay, model=vehicle), us)
        return jnp.sum(x.p[-1] + 0.3 * x.v[-1] + 0.1 * rates[-1]) + jnp.sum(x.R[-1, 2])

    slope = check_slope(jax.jit(cost), arguments, random.key(3), h=1e-5, rel=1e-4)
    assert abs(float(slope[0])) > 1e-3


# ---- by name


def test_conformance():
    testing.check_plant(lambda: Scenario(plant="second-order").make())


def test_vehicle_file_sets_lag_and_damping():
    body = ("made_up", 1.0, (0.02, 0.02, 0.03), (0.2, 0.2), 20.0, (4.0, 4.0, 3.0), 0.05)
    spec = VehicleSpec(*body, rate_lag=(0.07, 0.08, 0.4), rate_damping=(0.5, 0.5, 1.0))
    simulation = Scenario(plant="second-order", delay=0.0374, thrust_error=0.1).make(spec).simulation
    response = simulation.model.response
    np.testing.assert_allclose(response.rate_lag, [0.07, 0.08, 0.4])
    np.testing.assert_allclose(response.inverse_damping, [2.0, 2.0, 1.0])
    np.testing.assert_allclose([response.thrust_lag, response.thrust_gain], [0.05, 1.1])
    assert float(simulation.delay) == pytest.approx(0.0374)
    plain = Scenario(plant="second-order").make("small").simulation.model.response
    np.testing.assert_array_equal(plain.inverse_damping, 0.0)
    assert 0.01 < float(plain.rate_lag[0]) < 0.1  # that of the simulated rate loop
