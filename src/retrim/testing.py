"""Conformance suites: what every plant, task, controller and residual model must do, as functions for anyone's tests.

Each function raises ``AssertionError`` with the law that is broken::

    def test_my_plant():
        retrim.testing.check_plant(lambda: MyPlant())
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import random

from .control.controller import AbstractController
from .errors import PlantError
from .learn.residuals.model import ResidualModel
from .learn.residuals.targets import Targets
from .physics import so3
from .physics.state import STANDARD_GRAVITY, Command, State
from .plants.plant import Plant, as_numpy
from .tasks.observation import AbstractObservation
from .tasks.task import AbstractTask


def check_plant(make: Callable[[], Plant], *, x0: State | None = None, settle_s: float = 0.4) -> None:
    """Check a plant in calm air.

    Args:
        make: Builds a plant without disturbances.
        x0: State in which it starts; by default 1.5 m above the ground.
        settle_s: By when a body rate must have been reached, within a factor of two [s].

    Raises:
        AssertionError: A law does not hold.
    """
    start = State.at(jnp.array([0.3, -0.2, 1.5])) if x0 is None else x0
    plant = make()
    _require(isinstance(plant, Plant), "it has dt, reset, step, stop, __enter__ and __exit__")
    ticks = max(2, round(settle_s / plant.dt))

    first = plant.reset(start)
    _close(first.true_state.p, start.p, 1e-4, "reset puts it where it is told")
    for k in range(1, 4):
        measurement, accepted = plant.step(Command.hover())
        _close(measurement.t - first.t, k * plant.dt, 1e-6, "a tick takes dt by the plant's clock")
        _close(as_numpy(accepted), as_numpy(Command.hover()), 1e-6, "a command within the limits is accepted as it is")
        x = measurement.x
        _close(x.R @ x.R.T, np.eye(3), 1e-3, "the attitude is a rotation")
        _require(all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(x)), "measured states are finite")

    for bad in (Command(jnp.array(jnp.nan), jnp.zeros(3)), Command(jnp.array(9.81), jnp.array([0.0, jnp.inf, 0.0]))):
        try:
            plant.step(bad)
        except PlantError:
            continue
        raise AssertionError("a command that is not finite is refused with PlantError")
    after, _ = plant.step(Command.hover())
    _close(after.t - first.t, 4 * plant.dt, 1e-6, "a refused command costs no tick")

    hovered = _after(plant, start, Command.hover(), ticks)
    _require(float(jnp.linalg.norm(hovered.p - start.p)) < 0.3, "hover thrust hovers, within 0.3 m")
    higher = _after(plant, start, Command(jnp.array(STANDARD_GRAVITY + 3.0), jnp.zeros(3)), ticks)
    _require(float(higher.v[2] - hovered.v[2]) > 0.3 * 3.0 * settle_s, "more thrust accelerates it upwards, per mass")
    for axis, name in enumerate("xyz"):
        turned = _after(plant, start, Command(jnp.array(STANDARD_GRAVITY), jnp.zeros(3).at[axis].set(1.0)), ticks)
        angle = so3.log(start.R.T @ turned.R)
        _require(
            0.3 * settle_s < float(angle[axis]) < 1.2 * settle_s, f"a body rate about {name} turns it about {name}"
        )
        others = float(jnp.linalg.norm(jnp.delete(angle, axis, assume_unique_indices=True)))
        _require(others < 0.3 * float(angle[axis]), f"a body rate about {name} turns it about no other axis")

    plant.stop()
    plant.stop()
    try:
        plant.step(Command.hover())
    except PlantError:
        pass
    else:
        raise AssertionError("a stopped plant refuses commands with PlantError")
    plant.reset(start)
    with plant:
        pass
    try:
        plant.step(Command.hover())
    except PlantError:
        return
    raise AssertionError("leaving the context stops the plant")


def check_task(task: AbstractTask, *, starts: int = 16) -> None:
    """Check a task.

    Args:
        task: The task.
        starts: Random starts to look at.

    Raises:
        AssertionError: A law does not hold.
    """
    keys = random.split(random.key(0), starts)
    reset = jax.jit(jax.vmap(task.reset))
    x0, again = reset(keys), reset(keys)
    _require(all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(x0)), "starts are finite")
    _close(x0.x.p, again.x.p, 0.0, "a start follows from its key")
    _require(starts < 2 or not np.array_equal(x0.x.p[0], x0.x.p[1]), "starts differ")
    _require(not bool(jax.jit(jax.vmap(task.terminated))(x0.t, x0.x).any()), "no start is terminated")
    one = jax.tree.map(lambda leaf: leaf[0], x0)
    u = Command.hover()
    reward, slopes = _slopes(task, one.t, one.x, u)
    _require(jnp.shape(reward) == (), "the reward is a scalar")
    _require(
        all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((reward, slopes))), "reward and gradient are finite"
    )
    _require(any(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(slopes)), "the reward has a gradient")
    broken = State(jnp.full(3, jnp.nan), one.x.R, one.x.v)
    _require(bool(task.terminated(one.t, broken)), "a state that is not finite is terminated")
    away = State(one.x.p + 1e6, one.x.R, one.x.v)
    _require(bool(task.terminated(one.t, away)), "a vehicle 1000 km away is terminated")
    _require(float(task.error(one.t, one.x)) >= 0.0, "the error is not negative")
    _require(task.home().shape == (3,) and task.target(one.t).shape == (3,), "home and target are positions")
    _require(task.dt > 0 and task.horizon > 0, "dt and horizon are positive")
    off = float(task.error(one.t, State.at(task.target(one.t))))
    _require(abs(off) < 1e-3, "the error at the target is zero")
    for observation, name in ((task.observation, "training"), (task.observation_in_flight, "flight")):
        memory, (o, later) = _observed(observation, one.t, one.x, u)
        _require(o.shape == (observation.size,), f"the observation of {name} has its stated size")
        _require(bool(np.isfinite(o).all()), f"the observation of {name} is finite")
        _require(_shapes(memory) == _shapes(later), f"the memory of the observation of {name} keeps its shapes")
    _require(
        task.observation.size == task.observation_in_flight.size, "training and flight observe equally many numbers"
    )


@eqx.filter_jit
def _slopes(task: AbstractTask, t: Any, x: State, u: Command) -> Any:
    return jax.value_and_grad(lambda x, u: task.reward(t, x, u), argnums=(0, 1))(x, u)


@eqx.filter_jit
def _observed(observation: AbstractObservation[Any], t: Any, x: State, u: Command) -> Any:
    memory = observation.init(x)
    return memory, observation(memory, t, x, u)


def check_controller(controller: AbstractController[Any], *, x0: State | None = None) -> None:
    """Check a controller.

    Args:
        controller: The controller.
        x0: A state in which it can start.

    Raises:
        AssertionError: A law does not hold.
    """
    start = State.at(jnp.array([0.3, -0.2, 1.2])) if x0 is None else x0
    memory = controller.init(start)
    step = eqx.filter_jit(lambda controller, memory, t, x: controller(memory, t, x))
    t = jnp.zeros_like(start.p[0])
    u, later = step(controller, memory, t, start)
    _require(u.c.shape == () and u.omega.shape == (3,), "a command is a thrust and three body rates")
    _require(bool(np.isfinite(as_numpy(u)).all()), "commands are finite")
    _require(_shapes(memory) == _shapes(later), "the memory keeps its shapes")
    same, _ = step(controller, memory, t, start)
    _close(as_numpy(u), as_numpy(same), 0.0, "the same memory, time and state give the same command")
    corrected = controller.accepted(later, Command.hover())
    _require(_shapes(corrected) == _shapes(later), "a corrected memory keeps its shapes")


def check_residual(model: ResidualModel, *, fits: int = 5, tolerance: float = 0.5) -> None:
    """Check a residual model.

    Args:
        model: The model.
        fits: Number of fits after which a constant acceleration must have been learnt.
        tolerance: Largest error of its prediction then, as a share of the acceleration.

    Raises:
        AssertionError: A law does not hold.
    """
    _require(isinstance(model, ResidualModel), "it has init, fit, predict and spread")
    key, n = random.key(0), 60
    k_p, k_v, k_u, k_init = random.split(key, 4)
    p, v = (0.3 * random.normal(k, (n, 3)) for k in (k_p, k_v))
    x = jax.vmap(State)(p + jnp.array([[0.0, 0.0, 1.0]]), jnp.broadcast_to(jnp.eye(3), (n, 3, 3)), v)
    rates = 0.3 * random.normal(k_u, (n, 3))
    u = jax.vmap(Command)(jnp.full(n, STANDARD_GRAVITY), rates)
    wanted = jnp.array([1.0, -0.5, 0.8])
    rows = Targets(x, u, jnp.broadcast_to(wanted, (n, 3)), rates, jnp.ones(n, dtype=bool))
    state = model.init(k_init)
    at, command = jax.tree.map(lambda leaf: leaf[0], (x, u))
    _close(model.predict(state, at, command), np.zeros(3), 1e-6, "a fresh state predicts zero")
    fit, fitted = eqx.filter_jit(model.fit), state
    for _ in range(fits):
        fitted, rms = fit(fitted, rows)
    _require(_shapes(fitted) == _shapes(state), "a fit keeps the shapes of the state")
    _require(jnp.shape(rms) == () and bool(jnp.isfinite(rms)), "the error of a fit is a finite number")
    size = float(jnp.linalg.norm(wanted))
    _close(model.predict(fitted, at, command), wanted, tolerance * size, "a constant acceleration is learnt")
    spread = model.spread(fitted, at, command)
    _require(spread.shape == (3,) and bool((spread >= 0).all()), "the spread is three numbers, none negative")
    nothing = Targets(x, u, rows.a_res, rates, jnp.zeros(n, dtype=bool))
    kept, _ = fit(fitted, nothing)
    finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(eqx.filter(kept, eqx.is_array)))
    _require(finite, "a fit without a valid row stays finite")


def _after(plant: Plant, start: State, u: Command, ticks: int) -> State:
    plant.reset(start)
    for _ in range(ticks):
        measurement, _ = plant.step(u)
    return measurement.true_state


def _shapes(tree: Any) -> Any:
    return jax.tree.structure(tree), [(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in jax.tree.leaves(tree)]


def _require(holds: bool, law: str) -> None:
    if not holds:
        raise AssertionError(f"broken law: {law}")


def _close(found: Any, expected: Any, tolerance: float, law: str) -> None:
    away = float(np.max(np.abs(np.asarray(found) - np.asarray(expected))))
    if not away <= tolerance:
        raise AssertionError(f"broken law: {law}; found {np.asarray(found)}, expected {np.asarray(expected)}")
