"""Conformance suite for plants."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import PlantError
from ..physics import so3
from ..physics.state import STANDARD_GRAVITY, Command, State
from ..plants.plant import Plant, as_numpy
from .laws import close, require


def check_plant(make: Callable[[], Plant], *, x0: State | None = None, settle_s: float = 0.4) -> None:
    """Check a plant in calm air.

    Args:
        make: Function that builds a plant without disturbances.
        x0: Start state; by default, 1.5 m above the ground.
        settle_s: Time within which a body rate must be reached, within a factor of two [s].

    Raises:
        AssertionError: A law is broken.
    """
    start = State.at(jnp.array([0.3, -0.2, 1.5])) if x0 is None else x0
    plant = make()
    require(isinstance(plant, Plant), "it has dt, reset, step, stop, __enter__ and __exit__")
    ticks = max(2, round(settle_s / plant.dt))

    first = plant.reset(start)
    close(first.true_state.p, start.p, 1e-4, "reset sets the given state")
    for k in range(1, 4):
        measurement, accepted_command = plant.step(Command.hover())
        close(measurement.t - first.t, k * plant.dt, 1e-6, "a tick takes dt by the plant's clock")
        close(
            as_numpy(accepted_command),
            as_numpy(Command.hover()),
            1e-6,
            "a command within the limits is accepted as it is",
        )
        x = measurement.x
        close(x.R @ x.R.T, np.eye(3), 1e-3, "the attitude is a rotation")
        require(all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(x)), "measured states are finite")

    for bad in (Command(jnp.array(jnp.nan), jnp.zeros(3)), Command(jnp.array(9.81), jnp.array([0.0, jnp.inf, 0.0]))):
        try:
            plant.step(bad)
        except PlantError:
            continue
        raise AssertionError("a command that is not finite is refused with PlantError")
    after, _ = plant.step(Command.hover())
    close(after.t - first.t, 4 * plant.dt, 1e-6, "a refused command costs no tick")

    hover_state = _after(plant, start, Command.hover(), ticks)
    require(float(jnp.linalg.norm(hover_state.p - start.p)) < 0.3, "hover thrust hovers, within 0.3 m")
    higher = _after(plant, start, Command(jnp.array(STANDARD_GRAVITY + 3.0), jnp.zeros(3)), ticks)
    require(
        float(higher.v[2] - hover_state.v[2]) > 0.3 * 3.0 * settle_s, "more thrust accelerates it upwards, per mass"
    )
    for axis, name in enumerate("xyz"):
        turning = Command(jnp.array(STANDARD_GRAVITY), jnp.zeros(3).at[axis].set(1.0))
        turn_state = _after(plant, start, turning, ticks)
        angle = so3.log(start.R.T @ turn_state.R)
        require(0.3 * settle_s < float(angle[axis]) < 1.2 * settle_s, f"a body rate about {name} turns it about {name}")
        others = float(jnp.linalg.norm(jnp.delete(angle, axis, assume_unique_indices=True)))
        require(others < 0.3 * float(angle[axis]), f"a body rate about {name} turns it about no other axis")
        omega = plant.step(turning)[0].omega
        if omega is not None:
            close(omega, turning.omega, 0.5, f"where body rates are measured, they tell a turn about {name}")

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


def _after(plant: Plant, start: State, u: Command, ticks: int) -> State:
    plant.reset(start)
    for _ in range(ticks):
        measurement, _ = plant.step(u)
    return measurement.true_state
