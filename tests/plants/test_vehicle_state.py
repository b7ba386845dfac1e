"""Extrapolation of a state to the present: exact for constant thrust and rates, and applied once."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fake_vehicle import PointVehicle
from retrim.estimation.prediction import Prediction, Underway
from retrim.live.processes.vehicle import _sample
from retrim.onboard.guard import Limits
from retrim.physics import Command, CommandPath, State
from retrim.physics.actuator_response import ActuatorState
from retrim.physics.command_path import CommandQueue
from retrim.plants.bridges.vehicle_state import LONGEST_S, ExtraAcceleration, VehicleState

ages = st.floats(0.0, LONGEST_S)
# about its thrust axis, so that the motion has a closed form
LEANING, THRUST, SPIN = (0.3, -0.2, 1.0), 12.0, (0.0, 0.0, 1.5)


def state(age, omega=(0.0, 0.0, 0.0), rotation=(0.3, -0.2, 1.0), v=(1.0, -2.0, 0.5)):
    R = Rotation.from_rotvec(rotation).as_matrix()
    return VehicleState(np.array([0.1, 0.2, 1.5]), R, np.array(v), np.array(omega), age)


def test_recent_state_is_unchanged():
    x = state(0.0, omega=(1.0, 2.0, 3.0))
    for result, message in zip(x.extrapolate(12.0)[:4], x[:4], strict=True):
        np.testing.assert_allclose(result, message, atol=1e-12)


@given(ages, st.lists(st.floats(-8.0, 8.0), min_size=3, max_size=3))
def test_attitude_follows_body_rates(age, omega):
    x = state(age, omega)
    R = x.extrapolate(9.81).R
    np.testing.assert_allclose(R, x.R @ Rotation.from_rotvec(age * np.array(omega)).as_matrix(), atol=1e-9)


@given(ages)
def test_vehicle_falls_without_thrust_and_hovers_with_it(age):
    x = state(age, rotation=(0.0, 0.0, 0.4))
    fall_state, hover_state = x.extrapolate(0.0), x.extrapolate(9.81)
    np.testing.assert_allclose(hover_state.p, x.p + age * x.v, atol=1e-9)
    np.testing.assert_allclose(hover_state.v, x.v, atol=1e-9)
    np.testing.assert_allclose(hover_state.p - fall_state.p, [0.0, 0.0, 0.5 * 9.81 * age**2], atol=1e-9)
    np.testing.assert_allclose(hover_state.v - fall_state.v, [0.0, 0.0, 9.81 * age], atol=1e-9)


def test_steady_wind_is_estimated_and_extrapolated():
    wind, estimate, rng = np.array([1.5, -1.0, 0.5]), ExtraAcceleration(), np.random.default_rng(0)
    c, x, now = 12.0, state(0.015, rotation=(0.1, 0.2, 0.0)), 50.0
    nominal = c * x.R[:, 2] - np.array([0.0, 0.0, 9.81])
    for _ in range(150):
        now += rng.uniform(0.008, 0.03)
        age = rng.uniform(0.0, 0.02)
        v = (now - age) * (nominal + wind) + rng.normal(0.0, 2e-3, 3)
        x = x._replace(v=v, age=age)
        estimate.record(x, c, now)
        estimate.record(x, c, now + 1e-4)  # the same state again
    np.testing.assert_allclose(estimate.value, wind, atol=0.15)
    expected = x.v + x.age * (nominal + wind)
    np.testing.assert_allclose(x.extrapolate(c, estimate.value).v, expected, atol=0.15 * x.age + 1e-9)


def test_gap_and_velocity_jump_have_little_effect():
    estimate, x = ExtraAcceleration(), state(0.0, rotation=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0))
    for now in (0.0, 0.02, 0.04, 5.0):  # 5 s without a state
        estimate.record(x._replace(v=np.full(3, float(now > 1.0))), 9.81, now)
    np.testing.assert_allclose(estimate.value, 0.0, atol=1e-9)
    estimate.record(x._replace(v=np.full(3, -1.0)), 9.81, 5.02)
    assert np.abs(estimate.value).max() <= 10.0


def test_extrapolated_state_has_age_zero_and_message_keeps_its_age():
    x = state(0.02)._replace(truth=state(0.01))
    result = x.extrapolate(9.81)
    assert (result.age, result.truth.age) == (0.0, 0.0)
    assert (result.news, result.truth.news) == (0.02, 0.01)
    assert np.linalg.norm(result.p - result.truth.p) == pytest.approx(0.01 * np.linalg.norm(x.v), rel=0.1)


def test_extrapolation_is_limited():
    old, older = state(LONGEST_S).extrapolate(9.81), state(5.0).extrapolate(9.81)
    np.testing.assert_allclose(older.p, old.p)
    assert (old.age, older.age) == (0.0, 5.0 - LONGEST_S)
    assert older.news == 5.0


# ---- a controller behind a link


class SpinningVehicle(PointVehicle):
    """A vehicle that spins about its thrust axis at constant thrust; its messages are ``late`` seconds old."""

    def __init__(self, late):
        super().__init__(SimpleNamespace(dt=0.02))
        self.late, self.flying = late, True

    def now(self):
        # The time of this vehicle does not advance, so its states do not show an acceleration.
        self._extra = ExtraAcceleration()
        return super().now()

    def read(self):
        return at(-self.late)._replace(age=self.late)

    def wait(self, until):
        pass


def at(t):
    """Return the vehicle a while after ``state(0.0)``, in closed form."""
    x = state(0.0, SPIN, LEANING)
    a = THRUST * x.R[:, 2] - np.array([0.0, 0.0, 9.81])
    R = x.R @ Rotation.from_rotvec(t * np.array(SPIN)).as_matrix()
    return x._replace(p=x.p + t * x.v + 0.5 * t * t * a, R=R, v=x.v + t * a)


def use(x, age):
    """Return the state that a predicting controller uses as the present state."""
    acting = Command(jnp.array(THRUST), jnp.array(SPIN))
    prediction = Prediction.of(CommandPath.of(), 0.02).with_age(age)
    queue = CommandQueue.of(acting, 0.02, longest=0.0)
    return prediction(Underway(ActuatorState.at(acting), queue), x, jnp.zeros(3))[0]


def assert_agrees(result, true):
    for one, other in zip((result.p, result.R, result.v), true[:3], strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("late", [0.0, 0.005, 0.02, LONGEST_S, 0.08, 0.3])
def test_predicting_controller_uses_present_state(late):
    """Link and controller together compensate for the age of a message once."""
    plant = SpinningVehicle(late)
    plant.reset(None)
    measurement, _ = plant.step(Command(jnp.array(THRUST), jnp.array(SPIN)))
    assert_agrees(use(measurement.x, measurement.age), at(0.0))


@pytest.mark.parametrize("late", [0.0, 0.02, 0.08, 0.099])
def test_predicting_controller_in_live_flight_uses_present_state(late):
    plant = SpinningVehicle(late)
    plant.send(np.array([THRUST, *SPIN]))
    sample = _sample(3, 0.02, plant.now(), np.zeros(4))
    p, R, v = np.split(jnp.asarray(sample.state), [3, 12])
    assert_agrees(use(State(p, R.reshape(3, 3), v), sample.age), at(0.0))
    assert sample.age <= Limits.state_age


@pytest.mark.parametrize("late", [0.101, 0.12, 1.0])
def test_guard_receives_age_of_message(late):
    """The age of the message is relevant, not the remaining age after the extrapolation."""
    assert _sample(3, 0.02, SpinningVehicle(late).now(), np.zeros(4)).age == pytest.approx(late)
