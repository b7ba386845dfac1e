"""The whole loop: pretrain a policy, fly it where the world pushes, and let it re-train itself in flight.

You learn which objects there are: a preset (every number), a policy, a plant, a pilot, a flight. Printed are the loss
of pretraining, the hover error without and with adaptation, and what adaptation did when.
"""

import jax
import jax.numpy as jnp
import numpy as np

from retrim import ControllerPilot, Log, PolicyController, SimPlant, fly
from retrim.config import factory as build
from retrim.config import presets
from retrim.physics import BemQuadrotor, Push, small

QUICK = {
    "pretrain": {"epochs": 100, "envs": 8, "horizon": 100, "hidden": [32, 32]},
    "adapt": {"epochs": 3, "envs": 4, "iters": 20, "refine_every": 1.0, "improve_every": 2.0},
}


def error(log: Log, goal: tuple[float, float, float]) -> float:
    """Mean distance from the goal over the last two seconds [m]."""
    return float(np.linalg.norm(log.p[-100:] - np.array(goal), axis=1).mean())


def main(*, quick: bool = False) -> None:
    """Pretrain, fly twice, compare."""
    preset = presets.changed(presets.load("fast"), **(QUICK if quick else {}))
    ticks = 250 if quick else 1500  # of 20 ms

    # Pretrain in a model of one equation, which knows nothing of what follows.
    for trained, losses in build.pretraining(preset):  # after every ten epochs
        policy = trained
        print(f"pretraining: loss {float(losses[-1]):.3f}", end="\r")
    print()

    # A realistic plant, pushed by 2 m/s² along each axis: any function of time and state will do.
    plant = SimPlant(BemQuadrotor.of(small(), presets.DT), Push(lambda t, x: jnp.full_like(x.p, 2.0)))
    x0 = build.flight_starts(preset, 1)[0]

    base = ControllerPilot(PolicyController(build.seen_in_flight(preset), policy))
    print(f"without adaptation: {error(fly(plant, base, x0, ticks=ticks), preset.goal):.3f} m off")

    pilot = build.pilot(preset, policy, jax.random.key(1))
    print(f"with adaptation:    {error(fly(plant, pilot, x0, ticks=ticks), preset.goal):.3f} m off")
    for event in pilot.events:
        print(f"  {event.t:5.2f} s  {event.kind}: {event.note}")


if __name__ == "__main__":
    main()
