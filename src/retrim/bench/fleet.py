"""Works on several vehicles at once: flights of a plant, and policy updates of a fleet."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
from jax import lax, random
from jaxtyping import Array, Key

from ..adapt.gate import Verdict
from ..adapt.learner import LearnerState
from ..config.disturbances import disturbance
from ..config.loading import load
from ..config.setup import Setup
from ..control.controller import PolicyController
from ..learn.bptt import PolicyState
from ..learn.window import Window
from ..physics.bem import BemQuadrotor
from ..physics.state import State
from ..physics.vehicle import small
from ..plants.sim import SimPlant
from ..runtime.batch import batch_flight
from ..runtime.batched import stacked
from .flown import learner_in_flight
from .timing import compiled, timed


def eight() -> dict[str, Any]:
    """Eight flights of 30 s on bem, plant and policy as one program; four on each of two threads."""
    setup = Setup.of(load("hover/fast"))
    controller = PolicyController(setup.flown.observation_in_flight, setup.new_policy(random.key(0)))
    simulation = SimPlant(BemQuadrotor.of(small(), 0.02), disturbance("none")).simulation
    starts = setup.flight_starts(8)
    halves = [stacked(starts[i : i + 4]) for i in (0, 4)]

    @jax.jit
    def four(controller: PolicyController, x0s: State) -> State:
        flown: State = jax.vmap(lambda x0: batch_flight(simulation, controller, x0, ticks=1500).true)(x0s)
        return flown

    program, compile_s = compiled(four, controller, halves[0])
    with ThreadPoolExecutor(2) as pool:
        fly_all = lambda: list(pool.map(lambda x0s: jax.block_until_ready(program(controller, x0s)), halves))  # noqa: E731
        return timed(compile_s, fly_all, 3)


def fleet(how: str) -> dict[str, Any]:
    """Eight updates of eight vehicles."""
    learner, state, window = learner_in_flight()
    fitted, _ = learner.fit_residual(state.residual, window)
    keys = random.split(random.key(0), 8)

    def one(state: LearnerState, window: Window, key: Key[Array, ""]) -> tuple[PolicyState, Verdict]:
        return learner.update_policy(state.policy, state.residual, window, key)

    state = LearnerState(state.policy, fitted)
    if how == "threads":
        jax.block_until_ready(one(state, window, keys[0]))
        with ThreadPoolExecutor(2) as pool:
            row = timed(0.0, lambda: list(pool.map(lambda k: jax.block_until_ready(one(state, window, k)), keys)), 3)
        return row | {"compile_s": None, "remarks": row["remarks"] + "; compiled as one update"}

    @jax.jit
    def together(state: LearnerState, window: Window, keys: Key[Array, "8"]) -> tuple[PolicyState, Verdict]:
        if how == "map":
            return lax.map(lambda key: one(state, window, key), keys)  # type: ignore[no-any-return]
        return jax.vmap(lambda key: one(state, window, key))(keys)

    program, compile_s = compiled(together, state, window, keys)
    return timed(compile_s, lambda: program(state, window, keys), 3)
