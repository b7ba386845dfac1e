"""Convert a set-up's controller into programs for the control process."""

import hashlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...adapt.learner_state import LearnerState
from ...compile.trace import numpy_program, plain
from ...config.families import make_family
from ...config.setup import Setup
from ...control.belief_flight import vehicle_estimate
from ...control.condition import Condition
from ...control.controller import AbstractController
from ...control.policy import AbstractPolicy
from ...errors import ConfigError
from ...estimation.command_path import PathEstimator
from ...learn.bptt import PolicyState
from ...learn.residuals.model import FittedResidual
from ...onboard.pilot import ControllerSource
from ...onboard.topics import REFERENCE, VEHICLE
from ...physics.dynamics import f_a
from ...physics.state import Command, State
from ...tasks.paced_reference import Clock
from ...transport import wire


def parameter_groups(policy: AbstractPolicy, residual: Any) -> dict[str, Any]:
    """Return the parameters of a learning controller, by group: ``policy`` and ``residual``."""
    return {"policy": eqx.filter(policy, eqx.is_array), "residual": eqx.filter(residual, eqx.is_array)}


def adaptive_source(setup: Setup, state: LearnerState) -> ControllerSource:
    """Return the controller source of an adaptive policy.

    Args:
        setup: Set-up of the policy's preset with the flight's reference.
        state: Learned state from before the flight.

    Raises:
        ConfigError: The controller uses an operation without a NumPy form.
    """
    policy = state.policy.policy.merged()
    parts = eqx.partition((policy, state.residual), eqx.is_array)
    parameters = {"policy": parts[0][0], "residual": parts[0][1]}
    if setup.flight_reference is not None:
        parameters[REFERENCE] = setup.flight_reference
    parameters |= vehicle_half(setup, setup.controller(state))

    def whole(parameters: dict[str, Any]) -> tuple[AbstractPolicy, Any]:
        result: tuple[AbstractPolicy, Any] = eqx.combine((parameters["policy"], parameters["residual"]), parts[1])
        return result

    def controller(parameters: dict[str, Any]) -> AbstractController[Any]:
        policy, residual = whole(parameters)
        controller = _on(setup, parameters).controller(LearnerState(PolicyState(policy, ()), residual))
        return controller.follow(parameters[VEHICLE]) if VEHICLE in parameters else controller

    def predict(parameters: dict[str, Any], inputs: tuple[State, Command]) -> Any:
        model = FittedResidual(setup.learner.residual_model, whole(parameters)[1])
        return f_a(*inputs, model(*inputs)).v

    return _source(setup, controller, predict, parameters)


def plain_source(setup: Setup, controller: AbstractController[Any]) -> ControllerSource:
    """Return the controller source of a controller that does not learn.

    Raises:
        ConfigError: The controller uses an operation without a NumPy form.
    """
    half = vehicle_half(setup, controller)
    arrays, fixed = eqx.partition(controller, eqx.is_array)

    def predict(parameters: dict[str, Any], inputs: tuple[State, Command]) -> Any:
        return f_a(*inputs, jnp.zeros_like(inputs[0].p)).v

    def whole(parameters: dict[str, Any]) -> AbstractController[Any]:
        controller: AbstractController[Any] = eqx.combine(parameters["policy"], fixed)
        return controller.follow(parameters[VEHICLE]) if VEHICLE in parameters else controller

    return _source(setup, whole, predict, {"policy": arrays} | half)


def vehicle_half(setup: Setup, controller: AbstractController[Any]) -> dict[str, Any]:
    """Return the vehicle parameters of a controller that identifies its vehicle; empty for any other controller.

    Args:
        setup: Set-up of the flight.
        controller: Controller of the flight.

    Raises:
        ConfigError: The preset excites the vehicle.
    """
    family = make_family(setup.preset)
    if not controller.identifies or family is None:
        return {}
    if setup.preset.family is not None and setup.preset.family.excitation:
        raise ConfigError(
            "family.excitation: a live flight does not excite its vehicle; remove the key or set it to false"
        )
    _, estimate = PathEstimator.of(setup.preset.dt).start
    return {VEHICLE: vehicle_estimate(family, estimate)}


def _source(setup: Setup, controller: Any, prediction: Any, parameters: dict[str, Any]) -> ControllerSource:
    x, u = State.at(setup.flight_task.home()), Command.hover(setup.flight_task.home().dtype)
    t = jnp.zeros_like(x.p[0])

    def init(parameters: Any, x: State) -> Any:
        return controller(parameters).init(x)

    memory = _arrays(jax.jit(init)(parameters, x))

    def decide(parameters: Any, inputs: Any) -> Any:
        memory, t, age, x = inputs
        now = controller(parameters).with_age(age)
        u, after = now(memory, t, x)
        condition = now.condition(after) or Condition(jnp.array(0), jnp.array(0))
        clock = now.clock(after) or Clock(t, t, jnp.ones_like(t), jnp.zeros_like(t))
        return (u.c, u.omega, condition.stage, condition.cause, clock.phase, clock.pace, clock.growth), after

    def accept(parameters: Any, inputs: Any) -> Any:
        return controller(parameters).accept(*inputs)

    programs = {
        "init": numpy_program(init, parameters, x),
        "decide": numpy_program(decide, parameters, (memory, t, t, x)),
        "accepted": numpy_program(accept, parameters, (memory, u)),
        "target": numpy_program(lambda parameters, t: _on(setup, parameters).flight_task.target(t), parameters, t),
        "predicted": numpy_program(prediction, parameters, (x, u)),
    }
    # sorted, since JAX flattens dictionaries in the order of their keys
    names = {half: {n: plain(a) for n, a in wire.names(parameters[half]).items()} for half in sorted(parameters)}
    digest = hashlib.sha256()
    for program in programs.values():
        digest.update(program.text.encode())
    for half, arrays in names.items():
        digest.update(f"{half} {[(n, a.shape, a.dtype.name) for n, a in arrays.items()]}".encode())
    return ControllerSource(**programs, parameters=names, base=digest.hexdigest()[:16], dtype=np.dtype(x.p.dtype))


def _on(setup: Setup, parameters: dict[str, Any]) -> Setup:
    return setup.on(parameters[REFERENCE]) if REFERENCE in parameters else setup


def _arrays(memory: Any) -> Any:
    """Return a memory; raise ``TypeError`` if a leaf is not an array, since NumPy programs handle only arrays."""
    if not all(eqx.is_array(leaf) for leaf in jax.tree.leaves(memory)):
        raise TypeError("a controller's memory must be a pytree of arrays to fly live")
    return memory
