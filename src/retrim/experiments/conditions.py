"""The conditions of the gauntlet: everything that changes, and everything that differs from training."""

import numpy as np
from jaxtyping import Array

from ..config.scenario import Scenario
from ..config.vehicle_file import VehicleSpec
from ..physics.vehicle import small


def conditions() -> dict[str, Scenario]:
    """Return what is flown, by name; a function, since scenarios are checked when they are made."""
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
        "none/rough": Scenario(sensors="rough"),
        "step/rough": Scenario("step", sensors="rough"),
        "gusts/rough": Scenario("gusts", sensors="rough"),
        "kick": Scenario("kick"),
        "step/delay-40ms": Scenario("step", delay=0.04),
        "step/slow-motors": Scenario("step", vehicle=_like_small("slow-motors", motor_tau=2.0)),
        **{f"step/{vehicle.name}": Scenario("step", vehicle=vehicle) for vehicle in map(_random_vehicle, range(3))},
        "step/large-quadrotor": Scenario("step", vehicle="large"),
        "step/kingfisher": Scenario("step", vehicle="kingfisher"),
        "wind/simple": Scenario("wind", plant="simple"),
        "wind/rotorpy": Scenario("wind", plant="rotorpy"),
        "wind/mujoco": Scenario("wind", plant="mujoco"),
        "wind/crazyflow": Scenario("wind", plant="crazyflow"),
    }


def _like_small(
    name: str, *, mass: float = 1.0, thrust: float = 1.0, inertia: float = 1.0, motor_tau: float = 1.0
) -> VehicleSpec:
    """Return a vehicle as the small quadrotor, some of its numbers multiplied."""
    like = small()
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


def _random_vehicle(n: int) -> VehicleSpec:
    """Return a vehicle of 0.7 to 1.6 times the mass of the small one, with inertia, thrust and motors to match."""
    draw = np.random.default_rng(n)
    mass = float(draw.uniform(0.7, 1.6))
    inertia, thrust, motors = mass * draw.uniform(0.8, 1.25), draw.uniform(0.8, 1.2), draw.uniform(0.7, 2.0)
    return _like_small(f"random-{n}", mass=mass, inertia=float(inertia), thrust=float(thrust), motor_tau=float(motors))
