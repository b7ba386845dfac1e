"""Provide the inputs of an in-flight learner for benchmarks."""

from jax import random

from ..adapt.learner import OnlineLearner
from ..adapt.learner_state import LearnerState
from ..config.loading import load
from ..config.setup import Setup
from ..evaluation.compute_cost import full_window
from ..learn.window import Window


def learner_in_flight(name: str = "hover/paper") -> tuple[OnlineLearner, LearnerState, Window]:
    """Return a learner, its state before the first fit, and a full flight window with the large disturbance."""
    setup = Setup.from_preset(load(name))
    state = setup.learner.init(setup.new_policy(random.key(0)), random.key(1))
    return setup.learner, state, full_window(setup)
