"""Flying from pixels: the policy sees seven points on the ground through a camera, and never its own state.

You learn that such a policy first learns to see and then to fly, and that what it sees in flight may differ from
what it saw in training: here points out of sight are not observed, pixels are noisy, and some points are missed.
Printed are the loss of training, and the hover error in wind without and with adaptation.
"""

import jax
import jax.numpy as jnp
import numpy as np

from retrim import ControllerPilot, Log, PolicyController, SimPlant, fly
from retrim.config import factory as build
from retrim.config import presets
from retrim.physics import BemQuadrotor, SteadyWind, small

QUICK = {
    "represent": 100,
    "pretrain": {"epochs": 20, "envs": 4, "horizon": 60, "hidden": [32, 32]},
    "adapt": {"epochs": 2, "envs": 2, "iters": 20, "refine_every": 1.0, "improve_every": 1.5, "improve_charge": 0.5},
}


def error(log: Log, goal: tuple[float, float, float]) -> float:
    """Mean distance from the goal over the last two seconds [m]."""
    return float(np.linalg.norm(log.p[-100:] - np.array(goal), axis=1).mean())


def main(*, quick: bool = False) -> None:
    """Learn to see, learn to fly, fly in wind."""
    preset = presets.changed(presets.load("vision-honest"), **(QUICK if quick else {}))
    # Before it learns to fly it learns to see: to tell position, attitude and velocity from pixels of random motions.
    # In training every point is fed, seen or not.
    for trained, losses in build.pretraining(preset):  # after every ten epochs
        policy = trained
        print(f"pretraining: loss {float(losses[-1]):.3f}", end="\r")
    print()

    # In flight only what the camera sees is observed; a filter of the pose fills in the rest.
    honest = build.seen_in_flight(preset)
    plant = SimPlant(BemQuadrotor.of(small(), presets.DT), SteadyWind(jnp.array([2.0, 2.0, 0.0])))
    x0, ticks = build.flight_starts(preset, 1)[0], 150 if quick else 1500
    base = ControllerPilot(PolicyController(honest, policy))
    print(f"in 2.8 m/s of wind, not adapted: {error(fly(plant, base, x0, ticks=ticks), preset.goal):.3f} m off")

    pilot = build.pilot(preset, policy, jax.random.key(1))
    print(f"adapted in flight:               {error(fly(plant, pilot, x0, ticks=ticks), preset.goal):.3f} m off")


if __name__ == "__main__":
    main()
