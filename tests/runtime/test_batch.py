"""A flight as one program equals the flight of the plant and its pilot, tick for tick."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import hover_task
from retrim.control import Policy, PolicyController
from retrim.control.controller import AbstractController
from retrim.control.gravity_frame import GravityFrame
from retrim.estimation.disturbance_observer import DisturbanceObserver
from retrim.learn.stacking import stack, unstack
from retrim.physics import (
    Command,
    CommandPath,
    Constant,
    LinearDragQuadrotor,
    PointMass,
    SlungLoad,
    State,
    SumOfDisturbances,
    small,
)
from retrim.plants import SensorModel, SimPlant
from retrim.runtime import ControllerPilot, batch_flight, fly
from retrim.runtime.together import fly_together


@pytest.fixture(scope="module")
def plant_and_pilot():
    task = hover_task(history=2)
    policy = Policy.of(task.observation.size, small(), key=random.key(3), hidden=(8,))
    policy = jax.tree.map(lambda leaf: leaf + 0.02, policy)
    model, push = LinearDragQuadrotor.of(small(), 0.02), Constant(jnp.array([0.5, 0.0, 0.0]))
    return model, push, PolicyController(task.observation, policy), State.at(jnp.array([0.2, 0.1, 1.3]))


def assert_same(flight, log):
    for states, recorded in ((flight.true, log.true), (flight.measured, log.measured)):
        for name in ("p", "R", "v"):
            np.testing.assert_allclose(getattr(states, name), getattr(recorded, name)[1:], atol=1e-12)
    np.testing.assert_allclose(jax.vmap(lambda u: u.vector())(flight.accepted), log.u[1:], atol=1e-10)


SENSORS = SensorModel.of(position=0.01, velocity=0.01, attitude=0.01, latency=20, dropout=0.2)


@pytest.mark.parametrize(("delay_s", "sensors"), [(0.0, None), (0.02, None), (0.025, SENSORS)])
def test_equals_flight_of_plant(plant_and_pilot, delay_s, sensors):
    model, push, controller, x0 = plant_and_pilot
    plant = SimPlant(model, push, delay_s=delay_s, sensors=sensors, seed=4)
    log = fly(plant, ControllerPilot(controller), x0, ticks=15)
    assert_same(jax.jit(lambda x0: batch_flight(plant.simulation, controller, x0, ticks=15))(x0), log)


def test_slung_load_equals_flight_of_plant(plant_and_pilot):
    """The flight runs as one program, and in a batch of different loads whose launches share a program."""
    model, _, controller, x0 = plant_and_pilot
    loads = [SlungLoad.of(share, length=0.3, picked=0.1, dropped=0.24) for share in (0.1, 0.4)]
    plants = [SimPlant(model, SumOfDisturbances((load, Constant(jnp.ones(3))))) for load in loads]
    logs = [fly(plant, ControllerPilot(controller), x0, ticks=15) for plant in plants]
    for plant, log in zip(plants, logs, strict=True):
        assert_same(jax.jit(lambda x0, s=plant.simulation: batch_flight(s, controller, x0, ticks=15))(x0), log)
    pilots = [ControllerPilot(controller) for _ in loads]
    for log, other in zip(fly_together(plants, pilots, [x0, x0], ticks=15), logs, strict=True):
        np.testing.assert_allclose(log.true.p, other.true.p, atol=1e-6)
        np.testing.assert_allclose(log.u, other.u, atol=1e-5)
    assert np.abs(logs[0].true.p[-1] - logs[1].true.p[-1]).max() > 0.01


def test_late_measurement_is_predicted_to_present(plant_and_pilot):
    """The frame of effective gravity does this in both ways of flying: a drifting vehicle has its true position."""
    model, push, controller, x0 = plant_and_pilot
    observer = DisturbanceObserver(
        PointMass(0.02), jnp.array(0.05), jnp.array(6.0), jnp.array(4.0), CommandPath.of(0.02)
    )
    in_frame = GravityFrame(controller, observer)
    moving = State(x0.p, x0.R, jnp.array([2.0, 0.0, 0.0]))
    late, now = (SimPlant(model, push, sensors=SensorModel.of(latency=ms)) for ms in (10, 0))
    log = fly(late, ControllerPilot(in_frame), moving, ticks=15)
    assert_same(jax.jit(lambda x0: batch_flight(late.simulation, in_frame, x0, ticks=15))(moving), log)
    expected = fly(now, ControllerPilot(in_frame), moving, ticks=15)
    unaware = fly(late, ControllerPilot(IgnoresAge(in_frame)), moving, ticks=15)
    # Rates are those of the policy; thrust is that of the observer, which is delayed. The first sample is not.
    off, blind = (np.abs(each.u - expected.u)[3:, 1:].max() for each in (log, unaware))
    assert off < 0.5 * blind


class IgnoresAge(AbstractController):
    """A controller that ignores the age of measurements."""

    inner: AbstractController

    def init(self, x):
        return self.inner.init(x)

    def __call__(self, memory, t, x):
        return self.inner(memory, t, x)


class IncreasingThrust(AbstractController[Command]):
    """A controller that requests more thrust than was accepted."""

    def init(self, x):
        return Command.hover(x.p.dtype)

    def __call__(self, memory, t, x):
        u = Command(1.5 * memory.c, memory.omega + 40.0)
        return u, u

    def accept(self, memory, u):
        return u


def test_limits_of_plant_reach_memory_of_controller(plant_and_pilot):
    model, push, _, x0 = plant_and_pilot
    plant = SimPlant(model, push)
    log = fly(plant, ControllerPilot(IncreasingThrust()), x0, ticks=8)
    flight = jax.jit(lambda x0: batch_flight(plant.simulation, IncreasingThrust(), x0, ticks=8))(x0)
    assert_same(flight, log)
    assert float(flight.issued.c[-1]) == pytest.approx(1.5 * float(flight.accepted.c[-1]))  # no windup


def test_maps_over_vehicles_with_different_noise(plant_and_pilot):
    model, push, controller, x0 = plant_and_pilot
    plants = [SimPlant(model, push, sensors=SENSORS, seed=seed) for seed in (0, 1)]
    together = stack([plant.simulation for plant in plants])
    flight = jax.jit(jax.vmap(lambda s: batch_flight(s, controller, x0, ticks=5)))(together)
    assert flight.accepted.c.shape == (2, 5)
    assert not np.array_equal(flight.accepted.c[0], flight.accepted.c[1])
    assert_same(unstack(flight, 1), fly(plants[1], ControllerPilot(controller), x0, ticks=5))
