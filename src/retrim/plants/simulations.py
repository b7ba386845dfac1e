"""The plants that retrim simulates: ``bem``, ``simple`` and ``second-order``."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from ..physics.actuator_response import ActuatorResponse
from ..physics.bem import BemQuadrotor
from ..physics.rotors import LinearDragQuadrotor
from ..physics.second_order import DRAG, SecondOrderQuadrotor
from ..physics.step_response import step_responses
from ..physics.substep import AbstractSubstepDynamics
from .entry import PlantEntry, PlantRequest
from .plant import Plant
from .sim import SimPlant


def _entry(model: Callable[[PlantRequest], AbstractSubstepDynamics[Any]], about: str) -> PlantEntry:
    """Return the entry of a simulated plant, which supports sensors, faults, a thrust error and a delay."""

    def make(r: PlantRequest) -> Plant:
        return SimPlant(model(r), r.disturbance, delay_s=r.delay, sensors=r.sensors, fault=r.fault, seed=r.seed)

    return PlantEntry(
        make,
        f"{about}, at 1 kHz, 20 ms of command delay",
        has_sensors=True,
        has_faults=True,
        has_thrust_error=True,
        has_delay=True,
        has_disturbance_state=True,
    )


def _second_order(r: PlantRequest) -> SecondOrderQuadrotor:
    vehicle = r.vehicle
    lag = vehicle.rate_lag
    response = ActuatorResponse.of(
        vehicle.motor_tau,
        jnp.array([axis.rise for axis in step_responses(vehicle)]) if lag is None else lag,
        inverse_damping=0.0 if vehicle.rate_damping is None else 1.0 / vehicle.rate_damping,
        thrust_gain=1.0 + r.thrust_error,
    )
    limits = (vehicle.command_min, vehicle.command_max)
    return SecondOrderQuadrotor(response, vehicle.mass, jnp.array(DRAG), limits, r.dt)


bem = _entry(
    lambda r: BemQuadrotor.of(r.vehicle, r.dt, thrust_error=r.thrust_error),
    "blade-element rotors, firmware's rate loop, body drag",
)
simple = _entry(
    lambda r: LinearDragQuadrotor.of(r.vehicle, r.dt, thrust_error=r.thrust_error),
    "rotors with linear drag",
)
second_order = _entry(_second_order, "a point mass behind a rate loop of second order and a thrust lag")
