"""A vehicle of your own: change what differs from a known one, check it, and fly it with a policy made for another.

You learn to describe a vehicle, and to ask a plant whether hover thrust hovers. Printed are thrust-to-weight ratio and
hover check of both vehicles, and the hover error of the small one's policy on yours, without and with adaptation.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from retrim import ControllerPilot, PolicyController, SimPlant, fly
from retrim.config import factory as build
from retrim.config import presets
from retrim.physics import STANDARD_GRAVITY, BemQuadrotor, Command, Constant, State, Vehicle, small

QUICK = {
    "pretrain": {"epochs": 100, "envs": 8, "horizon": 100, "hidden": [32, 32]},
    "adapt": {"epochs": 3, "envs": 4, "iters": 20, "refine_every": 1.0, "improve_every": 2.0},
}
CALM = Constant(jnp.zeros(3))


def mine() -> Vehicle:
    """A third heavier, with arms half as long again; every other constant stays."""
    vehicle = small()
    return dataclasses.replace(vehicle, mass=jnp.array(0.25), arm=1.5 * vehicle.arm, inertia=2.5 * vehicle.inertia)


def check(name: str, vehicle: Vehicle) -> None:
    """Hold hover thrust, level, for half a second: the vehicle should neither rise nor fall by much."""
    plant = SimPlant(BemQuadrotor.of(vehicle, presets.DT), CALM)
    log = fly(plant, lambda sample: Command.hover(), State.at(jnp.array([0.0, 0.0, 1.0])), ticks=25)
    ratio = float(vehicle.command_max.c) / STANDARD_GRAVITY
    rise = log.v[-1, 2] / log.t[-1]
    print(f"{name}: thrust {ratio:.1f} times its weight; at hover thrust it accelerates by {rise:+.2f} m/s²")


def main(*, quick: bool = False) -> None:
    """Check both vehicles, fly mine with the small one's policy."""
    check("small", small())
    check("mine ", mine())

    preset = presets.changed(presets.load("fast"), **(QUICK if quick else {}))
    policy = build.pretrained(preset)  # for the small quadrotor
    plant = SimPlant(BemQuadrotor.of(mine(), presets.DT), CALM)
    x0, goal, ticks = build.flight_starts(preset, 1)[0], np.array(preset.goal), 250 if quick else 1500

    base = ControllerPilot(PolicyController(build.seen_in_flight(preset), policy))
    log = fly(plant, base, x0, ticks=ticks)
    print(f"small's policy on mine: {np.linalg.norm(log.p[-100:] - goal, axis=1).mean():.3f} m off")

    pilot = build.pilot(preset, policy, jax.random.key(1))
    log = fly(plant, pilot, x0, ticks=ticks)
    print(f"adapted in flight:      {np.linalg.norm(log.p[-100:] - goal, axis=1).mean():.3f} m off")


if __name__ == "__main__":
    main()
