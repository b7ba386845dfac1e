"""Benchmarks with several vehicles at once: flights on a plant, and policy updates for a fleet."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
from jax import lax, random
from jaxtyping import Array, Key

from ..adapt.gate import Verdict
from ..adapt.learner import OnlineLearner
from ..config.disturbances import disturbance
from ..config.setup import Setup
from ..control.controller import PolicyController
from ..learn.bptt import PolicyState
from ..learn.stacking import stack
from ..learn.window import Window
from ..physics.bem import BemQuadrotor
from ..physics.state import State
from ..physics.vehicle import small
from ..plants.sim import SimPlant
from ..runtime.batch import batch_flight
from .flight import learner_in_flight
from .timing import compile_function, time_runs

FLEET = 8  # number of vehicles
Update = Callable[[Key[Array, ""]], tuple[PolicyState, Verdict]]


def eight_flights() -> dict[str, Any]:
    """Time eight 30 s flights on ``bem``: two threads run four flights each, with plant and policy in one program."""
    setup = Setup.from_preset("hover/fast")
    controller = PolicyController(setup.flight_task.observation_in_flight, setup.new_policy(random.key(0)))
    simulation = SimPlant(BemQuadrotor.of(small(), 0.02), disturbance("none")).simulation
    starts = setup.flight_starts(8)
    halves = [stack(starts[i : i + 4]) for i in (0, 4)]

    @jax.jit
    def four(controller: PolicyController, x0s: State) -> State:
        states: State = jax.vmap(lambda x0: batch_flight(simulation, controller, x0, ticks=1500).true)(x0s)
        return states

    program, compile_s = compile_function(four, controller, halves[0])
    with ThreadPoolExecutor(2) as pool:
        fly_all = lambda: list(pool.map(lambda x0s: jax.block_until_ready(program(controller, x0s)), halves))  # noqa: E731
        return time_runs(compile_s, fly_all, 3)


def one_after_another() -> dict[str, Any]:
    """Time one program that makes eight policy updates in turn; return the table row."""
    return _as_one(lambda one, keys: lax.map(one, keys))


def side_by_side() -> dict[str, Any]:
    """Time one program that makes eight policy updates at once; return the table row."""
    return _as_one(lambda one, keys: jax.vmap(one)(keys))


def on_threads() -> dict[str, Any]:
    """Time eight policy updates on two threads, with one program; return the table row."""
    learner, policy, residual, window = _make_inputs()
    keys = random.split(random.key(0), FLEET)

    def update(key: Key[Array, ""]) -> tuple[PolicyState, Verdict]:
        result: tuple[PolicyState, Verdict] = jax.block_until_ready(
            learner.update_policy(policy, residual, window, key)
        )
        return result

    update(keys[0])
    with ThreadPoolExecutor(2) as pool:
        row = time_runs(0.0, lambda: list(pool.map(update, keys)), 3)
    return row | {"compile_s": None, "remarks": row["remarks"] + "; compiled as one update"}


def _as_one(together: Callable[[Update, Key[Array, " n"]], Any]) -> dict[str, Any]:
    learner, *inputs = _make_inputs()

    @jax.jit
    def fleet(inputs: list[Any], keys: Key[Array, " n"]) -> Any:
        policy, residual, window = inputs
        return together(lambda key: learner.update_policy(policy, residual, window, key), keys)

    arguments = inputs, random.split(random.key(0), FLEET)
    program, compile_s = compile_function(fleet, *arguments)
    return time_runs(compile_s, lambda: program(*arguments), 3)


def _make_inputs() -> tuple[OnlineLearner, PolicyState, Any, Window]:
    """Return the inputs of a policy update: the learner, a policy, a fitted residual and the window of the fit."""
    learner, state, window = learner_in_flight()
    residual, _ = learner.fit_residual(state.residual, window)
    return learner, state.policy, residual, window
