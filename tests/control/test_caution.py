"""Caution after a self-induced oscillation: its causes and its effects."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from retrim.control.belief_flight import BeliefFlight
from retrim.control.caution import Caution
from retrim.control.condition import Cause, Stage
from retrim.control.controller import AbstractController
from retrim.control.vehicle_report import VehicleEstimate
from retrim.physics import ActuatorResponse, Command, State, small, so3
from retrim.physics.effects import ExternalEffects
from retrim.physics.path_family import PathBelief, PathFamily
from retrim.physics.second_order import SecondOrderQuadrotor
from retrim.plants.sim import Simulation
from retrim.runtime.batch import batch_flight

pytestmark = pytest.mark.usefixtures("as_a_user")

DT = 0.02


def caution_levels(angles):
    """Return the level of caution while the vehicle rolls through the angles [rad]."""
    level = State.at(jnp.zeros(3))

    def step(caution, angle):
        x = dataclasses.replace(level, R=so3.exp(jnp.array([1.0, 0.0, 0.0]) * angle))
        caution = caution.after(x, DT)
        return caution, caution.level

    return np.asarray(lax.scan(step, Caution.none(level), jnp.asarray(angles, dtype=jnp.float32))[1])


def test_single_recovery_does_not_raise_caution():
    t = np.arange(0.0, 4.0, DT)
    assert caution_levels(0.8 * np.sin(7.0 * t) * np.exp(-2.0 * t)).max() == 0.0


def test_oscillation_raises_and_calm_flight_lowers_caution():
    t = np.arange(0.0, 4.0, DT)
    level = caution_levels(np.concatenate([0.9 * np.sin(7.0 * t), np.zeros(1500)]))
    assert level[len(t) - 1] > 0.5
    assert level[-1] < 0.05
    assert level.max() <= 1.0


def test_caution_without_effect_ends_for_a_while():
    """An oscillation that goes on has another cause than the estimate, e.g. measurements that are late."""
    t = np.arange(0.0, 14.0, DT)
    level = caution_levels(0.9 * np.sin(7.0 * t))
    rises, falls = (np.flatnonzero(np.diff(np.sign(level - 0.1)) == sign) for sign in (2.0, -2.0))
    assert len(rises) == 2
    assert 3.0 < DT * (falls[0] - rises[0]) < 4.0
    assert 5.0 < DT * (rises[1] - falls[0]) < 7.0
    assert np.all(level[falls[0] + 20 : rises[1] - 5] == 0.0)


def test_caution_only_slows_assumed_vehicle():
    belief = PathBelief.between(jnp.array([-0.8, -0.6, -0.3, 0.1]), jnp.array([-0.7, 0.7, 0.5, 0.4]))
    none = Caution.none(State.at(jnp.zeros(3)))
    for level in (0.0, 0.4, 1.0):
        low, high = dataclasses.replace(none, level=jnp.array(level)).apply(belief).ends
        for result, before in zip((low, high), belief.ends, strict=True):
            expected = np.minimum(np.array(before) + level * np.array([0.5, 0.5, 0.0, 0.0]), 1.0)
            np.testing.assert_allclose(result, expected, atol=1e-6)


def test_caution_reduces_thrust_commands():
    none = Caution.none(State.at(jnp.zeros(3)))
    assert float(none.gain(jnp.array(1.2))) == pytest.approx(1.2)
    assert float(dataclasses.replace(none, level=jnp.array(1.0)).gain(jnp.array(1.2))) == pytest.approx(1.8)


class StiffHover(AbstractController[None]):
    """A hover controller with a stiffness for the assumed vehicle; it is unstable on a much slower vehicle."""

    response_time: jnp.ndarray = dataclasses.field(default_factory=lambda: jnp.array(0.1))

    def init(self, x):
        del x

    def __call__(self, memory, t, x):
        bandwidth = 0.35 / self.response_time  # [rad/s] of the attitude
        wish = -((0.3 * bandwidth) ** 2) * x.p - 0.6 * bandwidth * x.v
        wish = wish * jnp.minimum(1.0, 8.0 / jnp.linalg.norm(wish + 1e-9))
        axis = jnp.array([0.0, 0.0, 1.0]) + wish * jnp.array([1.0, 1.0, 0.0]) / 9.81
        error = jnp.cross(x.R[:, 2], axis / jnp.linalg.norm(axis))
        return Command(9.81 + wish[2], bandwidth * (x.R.T @ error)), None

    def with_vehicle(self, member):
        return dataclasses.replace(self, response_time=member.response_time)


@pytest.mark.parametrize("watches", [False, True])
def test_caution_ends_oscillation_from_wrong_estimate(watches):
    """The estimate contains a quarter of the true delay and lag; without caution the oscillation does not end."""
    family = PathFamily.of()
    response = ActuatorResponse.of(0.03, 0.15, inverse_damping=1.0)
    limits = (small().command_min, small().command_max)
    model = SecondOrderQuadrotor(response, jnp.array(1.0), jnp.array(0.3), limits, DT)
    plant = Simulation(model, lambda t, x: ExternalEffects.calm(x.p.dtype), None, random.key(0), jnp.array(0.05))
    wrong = family.coordinates(jnp.array(0.0125), jnp.array(0.0375), jnp.array(0.3), jnp.array(0.03))
    belief = PathBelief.between(wrong, wrong)
    flight = BeliefFlight(StiffHover(), family, belief, VehicleEstimate(belief, jnp.array(1.0)), DT, watches)
    start = dataclasses.replace(State.at(jnp.array([0.5, -0.3, 0.0])), R=so3.exp(jnp.array([0.1, 0.0, 0.0])))
    ticks = batch_flight(plant, flight, start, ticks=600)
    error = np.linalg.norm(np.asarray(ticks.true.p)[:, :2], axis=-1)  # control of height needs an observer of the gain
    if not watches:
        assert error[-50:].mean() > 0.3
        assert ticks.condition is None
        return
    assert error.max() < 3.0
    assert error[-50:].mean() < 0.1
    stages, causes = np.asarray(ticks.condition.stage), np.asarray(ticks.condition.cause)
    assert stages[0] == Stage.ADAPTED
    assert causes[stages == Stage.CAUTIOUS][0] == Cause.SWINGS
