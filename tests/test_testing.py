"""The conformance suites accept valid objects, and report the violated law of invalid ones."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from helpers import hover_task
from retrim import Command, PolicyController, Scenario, Setup, load, testing
from retrim.control import AbstractController, Policy
from retrim.learn import EnsembleModel
from retrim.physics import State, small
from retrim.plants import Plant

pytestmark = pytest.mark.usefixtures("optax_promotion")


@pytest.mark.parametrize("plant", ["bem", "simple"])
def test_plants_conform(plant):
    testing.check_plant(Scenario(plant=plant).make)


class FaultyPlant(Plant):
    """A plant with one fault."""

    def __init__(self, fault):
        self._inner, self._fault = Scenario(plant="simple").make(), fault
        self.dt = self._inner.dt

    def reset(self, x0):
        return self._inner.reset(x0)

    def step(self, u):
        if self._fault == "sign":
            u = Command(u.c, u.omega * jnp.array([1.0, -1.0, 1.0]))
        if self._fault == "nan":
            u = Command(jnp.nan_to_num(u.c), jnp.nan_to_num(u.omega, posinf=0.0))
        if self._fault == "thrust":
            u = Command(9.81 + 0.1 * (u.c - 9.81), u.omega)
        measurement, accepted_command = self._inner.step(u)
        if self._fault == "time":
            measurement = measurement._replace(t=2 * measurement.t)
        if self._fault == "degrees":
            measurement = measurement._replace(omega=jnp.rad2deg(measurement.omega))
        return measurement, accepted_command

    def stop(self):
        if self._fault != "stop":
            self._inner.stop()


@pytest.mark.parametrize(
    ("fault", "law"),
    [
        ("sign", "a command within the limits|a body rate about y"),
        ("nan", "not finite is refused"),
        ("thrust", "more thrust accelerates"),
        ("time", "a tick takes dt"),
        ("degrees", "they tell a turn about x"),
        ("stop", "a stopped plant refuses"),
    ],
)
def test_violated_law_of_faulty_plant_is_reported(fault, law):
    with pytest.raises(AssertionError, match=law):
        testing.check_plant(lambda: FaultyPlant(fault))


@pytest.mark.parametrize("preset", ["hover/fast", "track/preview", "vision/occluded"])
def test_tasks_conform(preset):
    testing.check_task(Setup.from_preset(load(preset)).flight_task, starts=4)


def test_violated_law_of_faulty_task_is_reported():
    task = hover_task()

    class FlatReward(type(task)):
        def reward(self, t, x, u):
            return 0.0 * x.p[0]

    class NeverTerminated(type(task)):
        def terminated(self, t, x):
            return jnp.array(False)

    fields = {f.name: getattr(task, f.name) for f in dataclasses.fields(task)}
    with pytest.raises(AssertionError, match="the reward has a gradient"):
        testing.check_task(FlatReward(**fields), starts=2)
    with pytest.raises(AssertionError, match="not finite is terminated"):
        testing.check_task(NeverTerminated(**fields), starts=2)


def test_controllers_conform(key):
    task = hover_task(history=2)
    policy = Policy.of(task.observation.size, small(), key=key, hidden=(8,))
    testing.check_controller(PolicyController(task.observation, policy))

    class GrowingMemory(AbstractController[jax.Array]):
        def init(self, x):
            return jnp.zeros(1)

        def __call__(self, memory, t, x):
            return Command.hover(), jnp.concatenate([memory, memory])

    with pytest.raises(AssertionError, match="the memory keeps its shapes"):
        testing.check_controller(GrowingMemory())


def test_residual_models_conform():
    ensemble = EnsembleModel(jnp.array([0.0, 0.0, 1.0]), small().omega_max, jnp.array(1e-2), jnp.array(1e-3), steps=50)
    testing.check_residual(ensemble)

    class IgnoresRows(eqx.Module):
        def init(self, key):
            return jnp.zeros(3)

        def fit(self, state, rows):
            return state, jnp.array(0.0)

        def predict(self, state, x: State, u: Command):
            return state

        def spread(self, state, x: State, u: Command):
            return state

    with pytest.raises(AssertionError, match="a constant acceleration is learned"):
        testing.check_residual(IgnoresRows())
