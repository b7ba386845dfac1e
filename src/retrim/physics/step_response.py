"""Compute the step response of a vehicle's simulated rate loop about each axis, from hover."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array

from .betaflight import RELAX_CUTOFF, RELAX_RATE, Betaflight
from .rate_tuning import authority
from .substep import SUBSTEP
from .vehicle import Vehicle

STEP, LONGEST = 1.0, 2.0  # [rad/s], [s]


class StepResponse(NamedTuple):
    """Response to a step of 1 rad/s about one axis."""

    overshoot: float
    """Excess of the largest rate over the step, as a share of the step."""
    rise: float
    """Time to 63 % of the step [s]; infinite if this rate is not reached within 2 s."""


def step_responses(vehicle: Vehicle) -> tuple[StepResponse, StepResponse, StepResponse]:
    """Return the responses of a vehicle's rate loop about roll, pitch and yaw on the plant ``bem``.

    The vehicle's parameters must be numbers, also where a caller is being compiled.
    """
    with jax.ensure_compile_time_eval():
        tau, throttle, idle = (float(x) for x in (vehicle.motor_tau, _throttle(vehicle), vehicle.esc.idle))
        room, axes = (1.0 - throttle, throttle - idle), [numbers.tolist() for numbers in _loop(vehicle)]
    roll, pitch, yaw = (_response(*(numbers[k] for numbers in axes), tau=tau, room=room) for k in range(3))
    return roll, pitch, yaw


@eqx.filter_jit
def _loop(vehicle: Vehicle) -> tuple[Array, Array, Array, Array, Array]:
    """Return P, I and D in units of throttle, the authority, and the lead, per axis."""
    coefficient = vehicle.thrust_coefficient
    power, loop = authority(vehicle, coefficient), Betaflight.fit_vehicle(vehicle, coefficient, coefficient)
    p, i, d = (gain / power.alpha for gain in loop.gains(power))
    return p, i, d, power.alpha, power.lead


@eqx.filter_jit
def _throttle(vehicle: Vehicle) -> Array:
    return vehicle.esc.throttle(vehicle.hover_speed)


def _response(
    p: float, i: float, d: float, alpha: float, lead: float, *, tau: float, room: tuple[float, float]
) -> StepResponse:
    """Simulate an axis in steps of 1 ms; two rotors speed up as much as two slow down, each within its range."""
    rate = change = integral = acting = slow = largest = 0.0
    rise, keep, follow = math.inf, math.exp(-SUBSTEP / tau), math.exp(-2.0 * math.pi * RELAX_CUTOFF * SUBSTEP)
    for tick in range(round(LONGEST / SUBSTEP)):
        error = STEP - rate
        integral += SUBSTEP * error * max(0.0, 1.0 - abs(STEP - slow) / RELAX_RATE)
        slow = STEP + (slow - STEP) * follow
        turn = p * error + i * integral - d * change
        up, down = room if turn > 0.0 else room[::-1]
        step_size = math.copysign(0.5 * (min(abs(turn), up) + min(abs(turn), down)), turn)
        new = step_size + (acting - step_size) * keep
        change, acting = alpha * (new + lead * (new - acting) / SUBSTEP), new
        rate += SUBSTEP * change
        largest = max(largest, rate)
        if rate >= (1.0 - math.exp(-1.0)) * STEP and rise == math.inf:
            rise = (tick + 1) * SUBSTEP
        if not abs(rate) < 1e3:
            return StepResponse(math.inf, rise)
    return StepResponse(max(0.0, largest / STEP - 1.0), rise)
