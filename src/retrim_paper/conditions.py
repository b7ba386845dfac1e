"""Defines the gauntlet's conditions: changes in flight, and differences between training and flight."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Array

from retrim.config.faults import FAULTS, NO_FAULT
from retrim.config.presets import Preset
from retrim.config.scenario import Scenario
from retrim.config.vehicle_file import VehicleSpec
from retrim.config.vehicles import make_vehicle
from retrim.physics.vehicle import Vehicle, small


def conditions(preset: Preset, sensors: str = "ideal") -> dict[str, Scenario]:
    """Return a preset's scenarios by name: at hover, or on every reference of its training.

    Args:
        preset: Preset of the policy.
        sensors: Sensor model for every condition. If it is not ``ideal``, conditions that name their own sensors or use
            a plant without sensors are omitted.
    """
    result = _at_hover() if preset.track is None else _on_references(preset, preset.track.reference.split("+"))
    if sensors == "ideal":
        return result
    ideal_scenarios = {
        name: scenario
        for name, scenario in result.items()
        if scenario.sensors == "ideal" and scenario.entry.has_sensors
    }
    return {name: replace(scenario, sensors=sensors) for name, scenario in ideal_scenarios.items()}


def _on_references(preset: Preset, references: Sequence[str]) -> dict[str, Scenario]:
    result = {
        f"{reference}/{name}": Scenario(disturbance, sensors=sensors, reference=reference)
        for reference in references
        for name, (disturbance, sensors) in WEATHERS.items()
    }
    first, own = references[0], make_vehicle(preset.vehicle)
    others = {"slow-motors": _like(own, "slow-motors", motor_tau=2.0)}
    others |= {f"random-{n}": _random_vehicle(own, n) for n in range(3)}
    result |= {f"{first}/{name}": Scenario(vehicle=vehicle, reference=first) for name, vehicle in others.items()}
    result |= {
        f"{first}/thrust+20": Scenario(thrust_error=0.2, reference=first),
        f"{first}/thrust-20": Scenario(thrust_error=-0.2, reference=first),
        f"{first}/delay-40ms": Scenario(delay=0.04, reference=first),
        f"{first}/simple": Scenario("wind", plant="simple", reference=first),
    }
    return result


WEATHERS = {
    "none": ("none", "ideal"),
    "large": ("large", "ideal"),
    "step": ("step", "ideal"),
    "reversing": ("reversing", "ideal"),
    "wind": ("wind=4", "ideal"),
    "gusts": ("gusts", "ideal"),
    "walk": ("walk", "ideal"),
    "pickup": ("pickup", "ideal"),
    "weak-rotor": ("weak-rotor", "ideal"),
    "none-rough": ("none", "rough"),
    "gusts-rough": ("gusts", "rough"),
}
"""Conditions on each reference: the disturbance and the sensors, by name."""


def fault_conditions(preset: Preset) -> dict[str, Scenario]:
    """Return measurement and vehicle faults by name, each combined with a small push.

    Args:
        preset: Preset of a hover policy.
    """
    heavier = f"{PUSH}+payload={0.5 * float(make_vehicle(preset.vehicle).mass):.4g}"
    return {name: Scenario(PUSH, fault=name) for name in FAULTS if name != NO_FAULT} | {
        "late=2": Scenario(PUSH, fault="late=2"),
        "late=4": Scenario(PUSH, fault="late=4"),
        "delay-60ms": Scenario(PUSH, delay=0.06),
        "delay-80ms": Scenario(PUSH, delay=0.08),
        "mass+50": Scenario(heavier),
        "thrust-50": Scenario(PUSH, thrust_error=-0.5),
    }


PUSH = "small"


def _at_hover() -> dict[str, Scenario]:
    return {
        "none": Scenario(),
        "small": Scenario("small"),
        "large": Scenario("large"),
        "step": Scenario("step"),
        "reversing": Scenario("reversing"),
        "gusts": Scenario("gusts"),
        "fan": Scenario("fan"),
        "walk": Scenario("walk"),
        "pickup": Scenario("pickup"),
        "battery": Scenario("battery"),
        "weak-rotor": Scenario("weak-rotor"),
        "all": Scenario("wind+payload+battery+weak-rotor"),
        "thrust+20": Scenario("step", thrust_error=0.2),
        "thrust-20": Scenario("step", thrust_error=-0.2),
        "none/mocap": Scenario(sensors="mocap"),
        "none/onboard": Scenario(sensors="onboard"),
        "none/rough": Scenario(sensors="rough"),
        "step/rough": Scenario("step", sensors="rough"),
        "gusts/rough": Scenario("gusts", sensors="rough"),
        "fan/rough": Scenario("fan", sensors="rough"),
        "walk/rough": Scenario("walk", sensors="rough"),
        "kick": Scenario("kick"),
        "step/delay-40ms": Scenario("step", delay=0.04),
        "step/slow-motors": Scenario("step", vehicle=_like(small(), "slow-motors", motor_tau=2.0)),
        **{f"step/random-{n}": Scenario("step", vehicle=_random_vehicle(small(), n)) for n in range(3)},
        "step/large-quadrotor": Scenario("step", vehicle="large"),
        "step/kingfisher": Scenario("step", vehicle="kingfisher"),
        "wind/simple": Scenario("wind", plant="simple"),
        "wind/rotorpy": Scenario("wind", plant="rotorpy"),
        "wind/mujoco": Scenario("wind", plant="mujoco"),
        "wind/crazyflow": Scenario("wind", plant="crazyflow"),
    }


def _like(
    like: Vehicle, name: str, *, mass: float = 1.0, thrust: float = 1.0, inertia: float = 1.0, motor_tau: float = 1.0
) -> VehicleSpec:
    """Return a scaled copy of a vehicle; the numbers are factors, and the propellers are derived from the thrust."""
    return VehicleSpec(
        name=name,
        mass=mass * float(like.mass),
        inertia=_three(inertia * like.inertia),
        arm=(float(like.arm[0]), float(like.arm[1])),
        thrust_max=thrust * float(like.thrust_max),
        rates_max=_three(like.omega_max),
        motor_tau=motor_tau * float(like.motor_tau),
        drag_area=_three(like.drag_area),
    )


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = np.asarray(values).tolist()
    return x, y, z


def _random_vehicle(like: Vehicle, n: int) -> VehicleSpec:
    """Return a vehicle with 0.7 to 1.6 times the mass of ``like``, and random inertia, thrust and motor lag."""
    draw = np.random.default_rng(n)
    mass = float(draw.uniform(0.7, 1.6))
    inertia, thrust, motors = mass * draw.uniform(0.8, 1.25), draw.uniform(0.8, 1.2), draw.uniform(0.7, 2.0)
    numbers = {"inertia": float(inertia), "thrust": float(thrust), "motor_tau": float(motors)}
    return _like(like, f"random-{n}", mass=mass, **numbers)
