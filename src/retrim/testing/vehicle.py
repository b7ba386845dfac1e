"""Conformance suite for vehicle links, which arms and flies the vehicle; the vehicle must be simulated."""

import functools
import time
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from ..errors import PlantError
from ..onboard.guard import GeometricHover, Limits
from ..physics import so3
from ..physics.state import STANDARD_GRAVITY, Command, State
from ..plants.bridges.frames import heading_of
from ..plants.bridges.vehicle_plant import VehiclePlant
from ..plants.plant import Measurement, as_numpy
from .laws import close, require

HEADING = 0.5  # [rad]
OLDEST = 0.1  # [s]
PUSH_S, TURN_S = 0.5, 0.4


def check_vehicle(
    make: Callable[[], VehiclePlant], *, place: tuple[float, float, float] = (0.3, -0.2, 1.5), hover_s: float = 3.0
) -> None:
    """Check a link in calm air, in real time.

    Args:
        make: Function that builds a link to a vehicle on the ground.
        place: Position of the flight, world [m].
        hover_s: Duration of hovering with thrust and body-rate commands [s].

    Raises:
        AssertionError: A law is broken.
    """
    plant = make()
    require(isinstance(plant, VehiclePlant), "it is a VehiclePlant")
    for early, call in (("read", plant.read), ("step", lambda: plant.step(Command.hover()))):
        _check_refusal(call, f"{early} before reset is refused with PlantError")
    plant.stop()
    _check_refusal(lambda: plant.connect(lambda: False), "an aborted flight ends in PlantError")
    plant.stop()

    start = State(jnp.array(place), so3.exp(jnp.array([0.0, 0.0, HEADING])), jnp.zeros(3))
    with plant:
        _check_flight(plant, plant.reset(start), start, hover_s)
    plant.stop()
    _check_refusal(lambda: plant.step(Command.hover()), "a stopped plant refuses commands with PlantError")
    _check_refusal(plant.read, "a stopped plant has no state: PlantError")


def _check_flight(plant: VehiclePlant, first: Measurement, start: State, hover_s: float) -> None:
    require(first.t == 0.0, "a flight begins at the hand-over")
    close(first.x.p, start.p, 0.4, "reset flies to the given position")
    away = heading_of(np.asarray(first.x.R)) - HEADING
    close(np.sin(away), 0.0, 0.15, "reset turns to the given heading")
    close(first.x.R @ first.x.R.T, np.eye(3), 1e-3, "the attitude is a rotation, body to world")

    limits = Limits(np.full(3, -1e3), np.full(3, 1e3), plant.low, plant.high)
    hover, target = GeometricHover(limits, plant.dt), np.asarray(start.p, dtype=float)
    began, last, ages = time.monotonic(), first, []

    def hold_hover(seconds: float) -> None:
        """Hover with thrust and body-rate commands."""
        nonlocal last
        until = last.t + seconds
        while last.t < until:
            x = np.asarray(last.x.vector(), dtype=float)
            u = Command.of(jnp.asarray(hover.command(x, target), last.x.p.dtype))
            last, accepted_command = plant.step(u)
            close(as_numpy(accepted_command), as_numpy(u), 1e-3, "a command within the limits is accepted as it is")
            ages.append(plant.read().age)  # age of the last received state, because measurements are extrapolated

    hold_hover(hover_s)
    # The tolerance of 0.5 s allows for other load on the machine.
    close(time.monotonic() - began, last.t - first.t, 0.5, "the time of a measurement is that of the flight")
    close(last.x.p, start.p, 0.5, "thrust and body rates hover it")
    require(float(np.median(ages)) < OLDEST, f"a state is younger than {OLDEST} s")
    require(min(ages) >= 0.0, "no state is from the future")

    for bad in (Command(jnp.array(jnp.nan), jnp.zeros(3)), Command(jnp.array(9.81), jnp.array([0.0, jnp.inf, 0.0]))):
        _check_refusal(functools.partial(plant.step, bad), "a command that is not finite is refused with PlantError")
    last, accepted_command = plant.step(Command(jnp.array(1e3), jnp.zeros(3)))
    require(float(accepted_command.c) <= float(plant.high[0]), "a command beyond the limits is limited, and it says so")
    hold_hover(1.5)

    before = last
    for _ in range(round(PUSH_S / plant.dt)):
        last, _ = plant.step(Command(jnp.array(STANDARD_GRAVITY + 2.0), jnp.zeros(3)))
    require(float(last.x.v[2] - before.x.v[2]) > 0.3 * 2.0 * PUSH_S, "more thrust accelerates it upwards, per mass")
    hold_hover(2.0)
    for axis, name in enumerate("xyz"):
        before = last
        for _ in range(round(TURN_S / plant.dt)):
            last, _ = plant.step(Command(jnp.array(STANDARD_GRAVITY), jnp.zeros(3).at[axis].set(0.8)))
        angle = np.asarray(so3.log(before.x.R.T @ last.x.R))
        require(
            float(angle[axis]) > 0.05 * 0.8 * TURN_S, f"a body rate about {name} turns it about {name}, the right way"
        )
        assert last.omega is not None
        require(float(last.omega[axis]) > 0.1, f"a body rate about {name} is measured")
        hold_hover(1.5)


def _check_refusal(call: Callable[[], object], law: str) -> None:
    try:
        call()
    except PlantError:
        return
    raise AssertionError(f"broken law: {law}")
