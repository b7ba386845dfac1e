"""A controller without a load model flies a slung load: the pull is compensated, and the swing is damped."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import CheapModel, hover_task
from retrim.control.attitude import command_for, thrust_of
from retrim.control.controller import AbstractController
from retrim.control.gravity_frame import GravityFrame
from retrim.control.slung_load import LoadCompensation
from retrim.estimation.disturbance_observer import DisturbanceObserver
from retrim.physics import Command, CommandPath, Constant, PointMass, SlungLoad, State, SumOfDisturbances
from retrim.physics.slung_load import swing_angle
from retrim.plants import SimPlant
from retrim.runtime import ControllerPilot, fly
from retrim.testing import check_controller

DT = 0.02
HOME = np.array([0.0, 0.0, 1.0])
TASK = hover_task()


class GoalKeeper(AbstractController[tuple[()]]):
    """A proportional-derivative law for a goal, in any frame."""

    goal: jax.Array

    def init(self, x):
        return ()

    def __call__(self, memory, t, x):
        thrust = thrust_of(30.0 * (self.goal - x.p) - 9.0 * x.v)
        return command_for(x, thrust, TASK.setpoint(t), jnp.array([20.0, 20.0, 8.0])), ()

    def in_frame(self, frame):
        return GoalKeeper(frame.vector(self.goal))


def controller(load=True):
    observer = DisturbanceObserver(PointMass(DT), jnp.array(0.05), jnp.array(6.0), jnp.array(4.0), CommandPath.of(0.0))
    compensation = LoadCompensation(TASK) if load else None
    return GravityFrame(GoalKeeper(jnp.asarray(HOME)), observer, load=compensation, lead=jnp.array(0.5 * DT))


def flight(with_load, *parts, seconds=8.0, x0=None):
    """Return the log of a flight that starts 1 m from the goal, and the swing after each tick [deg]."""
    plant = SimPlant(CheapModel(), SumOfDisturbances(parts), delay_s=0.0)
    start = State.at(jnp.array([1.0, 0.3, 1.2])) if x0 is None else x0
    angles = []

    class Watch(ControllerPilot):
        def act(self, measurement):
            if plant._state.disturbance:
                angle = swing_angle(plant._state.disturbance[0], plant.simulation.true(plant._state))
                angles.append(np.degrees(float(angle)))
            return super().act(measurement)

    log = fly(plant, Watch(controller(with_load)), start, ticks=round(seconds / DT))
    return log, np.array(angles)


def error(log, begin):
    return np.linalg.norm(log.true.p[round(begin / DT) :] - HOME, axis=1)


@pytest.mark.parametrize(("share", "length"), [(0.2, 0.5), (0.4, 0.3)])
def test_swing_decays_and_vehicle_comes_to_rest(share, length):
    load = SlungLoad.of(share, length=length)
    log, swing = flight(True, load)
    _, without = flight(False, load)
    assert swing[:100].max() > 20.0  # the flight to the goal excites the swing
    assert swing[300:].max() < 5.0
    assert swing[300:].max() < 0.5 * without[300:].max()
    assert error(log, 6.0).max() < 0.05


def test_compensation_without_load_has_no_effect():
    push = Constant(jnp.array([1.0, -0.5, 0.5]))
    one, _ = flight(True, push)
    other, _ = flight(False, push)
    assert np.linalg.norm(one.true.p - other.true.p, axis=1)[100:].max() < 0.06
    assert error(one, 7.0).max() < 0.02


def test_pick_up_and_release_in_hover_move_vehicle_little():
    load = SlungLoad.of(0.3, picked=3.0, dropped=6.0)
    log, _ = flight(True, load, seconds=9.0, x0=State.at(jnp.asarray(HOME)))
    assert error(log, 0.0).max() < 0.3
    assert error(log, 5.5)[:20].max() < 0.02
    assert error(log, 8.5).max() < 0.02


def test_zero_trust_leaves_only_observer():
    load = SlungLoad.of(0.3)
    frame = dataclasses.replace(controller(), trust_residual=jnp.array(0.0))
    logs = [
        fly(SimPlant(CheapModel(), load, delay_s=0.0), ControllerPilot(each), State.at(jnp.asarray(HOME)), ticks=50)
        for each in (frame, controller(False))
    ]
    np.testing.assert_allclose(logs[0].u, logs[1].u, atol=1e-9)


def test_controller_conformance():
    check_controller(controller(), x0=State.at(jnp.asarray(HOME)))


def test_frame_is_equivariant_to_heading(key):
    """The motion of the frame follows the swing for any heading."""
    compensation, x = LoadCompensation(TASK), State.at(jnp.asarray(HOME))
    memory = compensation.init(x)
    z = memory.estimate.z.at[:4].set(random.normal(key, (4,)) * 0.3).at[7].set(0.3)

    def sway(z):
        estimate = dataclasses.replace(memory.estimate, z=z)
        s = dataclasses.replace(memory, estimate=estimate)
        pull, after = compensation.plan(s, jnp.array(0.0), jnp.array(0.05), DT)
        return pull, after.sway.a

    quarter = jnp.concatenate([jnp.stack([-z[1], z[0], -z[3], z[2]]), z[4:]])
    (pull, a), (pull_turned, a_turned) = sway(z), sway(quarter)
    np.testing.assert_allclose(a_turned, jnp.stack([-a[1], a[0], a[2]]), atol=1e-12)
    np.testing.assert_allclose(pull_turned, jnp.stack([-pull[1], pull[0], pull[2]]), atol=1e-12)
    assert float(a[:2] @ z[2:4]) > 0.0  # along the velocity of the load, which takes energy from the swing
    assert float(a[2]) == 0.0


def test_planned_state_includes_weight_of_load():
    """With a load of 30 % the vehicle needs 1.3 times its own thrust, so a flight at a variable pace is slower."""
    frame, x = controller(), State.at(jnp.asarray(HOME))
    memory = frame.init(x)
    estimate = memory.load.estimate
    heavy = dataclasses.replace(estimate, z=estimate.z.at[7].set(0.3))
    memory = dataclasses.replace(memory, load=dataclasses.replace(memory.load, estimate=heavy))
    up = thrust_of(jnp.zeros(3))
    needed = up - frame.disturbance(memory, x, Command.hover())
    np.testing.assert_allclose(needed, 1.3 * up, rtol=1e-6)
