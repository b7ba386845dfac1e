"""Low-rank adaptation: the pretrained policy is frozen, and only a thin delta on it is trained in flight.

You learn to adapt with a LoraPolicy instead of a Policy, and to merge it into plain weights. Printed are how many
numbers each trains, the hover error without and with adaptation, and by how much base and merged weights moved.
"""

import jax
import jax.numpy as jnp
import numpy as np

from retrim import AdaptivePilot, ControllerPilot, LoraPolicy, PolicyController, SimPlant, fly
from retrim.config import factory as build
from retrim.config import presets
from retrim.physics import BemQuadrotor, Constant, small

QUICK = {
    "pretrain": {"epochs": 100, "envs": 8, "horizon": 100, "hidden": [32, 32]},
    "adapt": {"epochs": 3, "envs": 4, "iters": 20, "refine_every": 1.0, "improve_every": 2.0},
}


def numbers(tree: object) -> int:
    """How many numbers there are in a tree of arrays."""
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


def moved(before: object, after: object) -> float:
    """The largest change of any number in a tree of arrays."""
    pairs = zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)
    return max(float(jnp.max(jnp.abs(new - old))) for old, new in pairs)


def main(*, quick: bool = False) -> None:
    """Adapt a delta, then merge it."""
    preset = presets.changed(presets.load("fast"), **(QUICK if quick else {}))
    policy = build.pretrained(preset)
    lora = LoraPolicy.of(policy, key=jax.random.key(1))  # ranks 4, 10, 1; it starts as a delta of zero
    print(f"trained in flight: {numbers(lora.trained)} numbers instead of {numbers(policy.trained)}")

    plant = SimPlant(BemQuadrotor.of(small(), presets.DT), Constant(jnp.full(3, 2.0)))
    x0, ticks = build.flight_starts(preset, 1)[0], 250 if quick else 1500

    def error(pilot: ControllerPilot | AdaptivePilot) -> float:
        """Fly; mean distance from the goal over the last two seconds [m]."""
        log = fly(plant, pilot, x0, ticks=ticks)
        return float(np.linalg.norm(log.p[-100:] - np.array(preset.goal), axis=1).mean())

    pilot = build.pilot(preset, lora, jax.random.key(2))
    seen = build.seen_in_flight(preset)
    print(f"base policy:            {error(ControllerPilot(PolicyController(seen, policy))):.3f} m off")
    print(f"adapted, low rank:      {error(pilot):.3f} m off")

    learnt = pilot.state.policy.policy  # the LoraPolicy that flies now
    merged = learnt.merged()  # an ordinary Policy: save_policy keeps it, save_delta the thin part alone
    print(f"merged, from the start: {error(ControllerPilot(PolicyController(seen, merged))):.3f} m off")
    print(f"base weights moved by {moved(policy, learnt.base)}, merged ones by up to {moved(policy, merged):.4f}")


if __name__ == "__main__":
    main()
