"""Low-rank adaptation: the pretrained policy is frozen, and only a thin delta on it is trained in flight.

You learn to adapt a LoraPolicy instead of a Policy, and to merge it into plain weights. Printed are how many numbers
each trains, the hover error without and with adaptation, and by how much base and merged weights moved.
"""

import jax
import jax.numpy as jnp
import numpy as np

from retrim import Pilot, Scenario, Setup, changed, fly, load

QUICK = {
    "pretrain": {"num_updates": 20, "num_envs": 4, "horizon": 60, "hidden_sizes": [32, 32]},
    "adapt": {"num_updates": 3, "num_envs": 4, "fit_steps": 20, "fit_every": 1.0, "update_every": 2.0},
}


def size(tree: object) -> int:
    """Return how many numbers there are in a tree of arrays."""
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


def change(before: object, after: object) -> float:
    """Return the largest change of any number in a tree of arrays."""
    return max(float(jnp.max(jnp.abs(d))) for d in jax.tree.leaves(jax.tree.map(jnp.subtract, before, after)))


def main(*, quick: bool = False) -> None:
    """Adapt a delta, then merge it."""
    preset = changed(load("hover/fast"), **(QUICK if quick else {}))
    setup, ticks = Setup.from_preset(preset), 100 if quick else 1500
    policy = setup.pretrained()
    thin = setup.low_rank(policy, jax.random.key(1))  # ranks 4, 10, 1; it starts as a delta of zero
    print(f"trained in flight: {size(thin.params)} numbers instead of {size(policy.params)}")

    plant, x0 = Scenario("large").make(), setup.flight_starts(1)[0]

    def error(pilot: Pilot) -> float:
        """Fly; return the mean distance from the goal over the last two seconds [m]."""
        log = fly(plant, pilot, x0, ticks=ticks)
        return float(np.linalg.norm(log.p[-100:] - preset.goal, axis=1).mean())

    pilot = setup.adaptive_pilot(thin, jax.random.key(2))
    print(f"base policy:            {error(setup.pilot(policy)):.3f} m off")
    print(f"adapted, low rank:      {error(pilot):.3f} m off")

    active = pilot.state.policy.policy  # the LoraPolicy that flies now; save_delta keeps its thin part alone
    plain = active.merged()  # an ordinary Policy, for save_policy
    print(f"merged, from the start: {error(setup.pilot(plain)):.3f} m off")
    print(f"base weights moved by {change(policy, active.base)}, merged ones by up to {change(policy, plain):.4f}")


if __name__ == "__main__":
    main()
