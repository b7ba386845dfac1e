"""What a learner has in flight, for the bench to time."""

from jax import random

from ..adapt.buffer import RollingBuffer
from ..adapt.learner import LearnerState, OnlineLearner
from ..config.loading import load
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..learn.window import Window
from ..physics.state import Command


def learner_in_flight(name: str = "hover/paper") -> tuple[OnlineLearner, LearnerState, Window]:
    """A learner, its state before the first fit, and a full window of flight under the large disturbance."""
    setup = Setup.of(load(name))
    plant = Scenario("large").make()
    buffer = RollingBuffer(setup.preset.adapt.window)
    measurement = plant.reset(setup.flight_starts(1)[0])
    for _ in range(setup.preset.adapt.window):
        buffer.push(measurement.t, measurement.x, Command.hover())
        measurement, _ = plant.step(Command.hover())
    state = setup.learner.init(setup.new_policy(random.key(0)), random.key(1))
    return setup.learner, state, buffer.window()
