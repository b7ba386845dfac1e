"""Camera sensors: an unbiased estimate with a true covariance, without the vehicle's parameters or its commands."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import CheapModel, random_state
from retrim.errors import PlantError
from retrim.estimation.pose_filter import PoseFilter
from retrim.physics import Command, Constant, State, so3
from retrim.physics.actuator_response import ActuatorResponse
from retrim.physics.second_order import SecondOrderQuadrotor
from retrim.physics.state import STANDARD_GRAVITY
from retrim.plants import SimPlant
from retrim.plants.camera_sensors import CameraSensors

START = State.at(jnp.array([0.1, -0.2, 1.0]))
GRAVITY = np.array([0.0, 0.0, -STANDARD_GRAVITY])
EXACT = {"pixel_noise": 0.0, "dropout": 0.0, "gyro": 0.0, "accelerometer": 0.0}


def plant(sensors, *, lag=0.05, seed=0, push=(0.0, 0.0, 0.0)):
    response = ActuatorResponse.of(0.03, lag, thrust_gain=1.2)
    limits = Command(jnp.array(0.0), jnp.full(3, -10.0)), Command(jnp.array(30.0), jnp.full(3, 10.0))
    model = SecondOrderQuadrotor(response, jnp.array(0.5), jnp.array(0.0), limits, 0.02)
    return SimPlant(model, Constant(jnp.array(push)), sensors=sensors, seed=seed)


def fly(plant, ticks=100, start=START):
    """Swing about hover; a thrust gain of 1.2 would lift a vehicle that commands its weight."""
    flight = [plant.reset(start)]
    for k in range(ticks):
        omega = 0.6 * np.cos(0.02 * k * np.array([5.0, 4.0, 3.0]) + np.array([0.0, 0.5, 1.0]))
        flight.append(plant.step(Command(jnp.array(STANDARD_GRAVITY / 1.2), jnp.array(omega)))[0])
    return flight


def errors(flight, after=25):
    p, v, turn = (
        np.stack([getattr(m.x, name) - getattr(m.truth, name) for m in flight[after:]]) if name != "R" else
        np.stack([so3.log(m.truth.R.T @ m.x.R) for m in flight[after:]])
        for name in ("p", "v", "R")
    )  # fmt: skip
    return p, v, turn


@pytest.mark.parametrize(("lag", "push"), [(0.01, (0.0, 0.0, 0.0)), (0.15, (1.0, -1.0, 0.5))])
def test_exact_measurements_give_state_of_unknown_vehicle(lag, push):
    """The sensors know neither the lag, nor the thrust gain, nor the push."""
    p, v, turn = errors(fly(plant(CameraSensors.of(**EXACT), lag=lag, push=push)))
    assert np.abs(p).max() < 1e-3
    assert np.abs(v).max() < 5e-3
    assert np.abs(turn).max() < 1e-3


def test_errors_agree_with_covariance_of_filter():
    """Normalised squared errors of position, attitude and velocity have a mean near their number."""
    squares = []
    for seed in range(6):
        simulated = plant(CameraSensors.of(), seed=seed)
        flight = fly(simulated, ticks=80)
        P = np.asarray(simulated._state.samples.pose.P)[:9, :9]
        p, v, turn = (part[-1] for part in errors(flight))
        error = np.concatenate([p, turn, v])
        squares.append(error @ np.linalg.solve(P, error))
    assert 3.0 < np.mean(squares) < 14.0


def test_measured_acceleration_follows_estimated_attitude():
    flight = fly(plant(CameraSensors.of(**EXACT)))
    for before, now in itertools.pairwise(flight[40:60]):
        force = now.truth.R.T @ ((now.truth.v - before.truth.v) / 0.02 - GRAVITY)
        np.testing.assert_allclose(now.a, now.x.R @ force + GRAVITY, atol=1e-6)


def test_estimate_continues_without_visible_points():
    """Far from the pattern, only the inertial unit remains: 20 s of drift stay finite."""
    far = State.at(jnp.array([30.0, 0.0, 1.0]))
    flight = fly(plant(CameraSensors.of()), ticks=100, start=far)
    p, *_ = errors(flight)
    assert np.isfinite(p).all()
    assert np.abs(p).max() < 5.0


def test_noise_depends_on_seed_only():
    first, again, other = (fly(plant(CameraSensors.of(), seed=seed), ticks=5)[-1] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.x.p, again.x.p)
    np.testing.assert_array_equal(first.omega, again.omega)
    assert not np.array_equal(first.x.p, other.x.p)
    np.testing.assert_array_equal(first.truth.p, other.truth.p)


def test_plant_without_body_rates_is_refused():
    simulated = SimPlant(CheapModel(0.02), Constant(jnp.zeros(3)), sensors=CameraSensors.of())
    simulated.reset(START)
    with pytest.raises(PlantError, match="need an inertial unit"):
        simulated.step(Command.hover())


@pytest.mark.parametrize("values", [{"pixel_noise": -1.0}, {"gyro": float("nan")}, {"dropout": 1.0}])
def test_impossible_values_are_refused(values):
    with pytest.raises(ValueError, match=f"CameraSensors.{next(iter(values))}"):
        CameraSensors.of(**values)


def test_covariance_of_prediction_equals_linearised_motion(key):
    """The transition of the covariance is the derivative of the prediction with respect to errors of the state."""
    k_state, k_filter, k_unit = random.split(key, 3)
    pose = PoseFilter.near(random_state(k_state), k_filter)
    omega, force = random.normal(k_unit, (2, 3)) * jnp.array([[2.0], [5.0]]) + jnp.array([[0.0], [3.0]])
    dt, none = 0.02, (jnp.array(0.0), jnp.array(0.0))

    def moved(off):
        x = State(pose.x.p + off[:3], pose.x.R @ so3.exp(off[3:6]), pose.x.v + off[6:])
        return PoseFilter(x, pose.d, pose.P, pose.acting).predict_by_unit(omega, force, dt, none).x

    centre = moved(jnp.zeros(9))

    def deviation(off):
        x = moved(off)
        return jnp.concatenate([x.p - centre.p, so3.log(centre.R.T @ x.R), x.v - centre.v])

    F = jax.jacfwd(deviation)(jnp.zeros(9))
    result = pose.predict_by_unit(omega, force, dt, none).P[:9, :9]
    # The position's share of the specific force, dt^2 / 2, is neglected in the covariance.
    np.testing.assert_allclose(result, F @ pose.P[:9, :9] @ F.T, atol=2e-5)
