"""Pretrain a hover policy, fly it under a push, and re-train it in flight.

The example introduces the main objects: a preset contains all numbers, a set-up builds the objects, a scenario makes a
plant, and a pilot flies the plant. It prints the pretraining loss, the hover error of each method, and the events of
the adaptation.
"""

import jax
import numpy as np

from retrim import Scenario, Setup, changed, fly, load

QUICK = {
    "pretrain": {"num_updates": 20, "num_envs": 4, "horizon": 60, "hidden_sizes": [32, 32]},
    "adapt": {"num_updates": 3, "num_envs": 4, "fit_steps": 20, "fit_every": 1.0, "update_every": 2.0},
}


def main(*, quick: bool = False) -> None:
    """Pretrain a policy, fly it as it is, and fly it as it adapts."""
    preset = changed(load("hover/fast"), **(QUICK if quick else {}))
    setup, ticks = Setup.from_preset(preset), 100 if quick else 1500

    # The training model is one equation, without the disturbances of the flights below.
    *_, (policy, losses) = setup.pretraining()
    print(f"pretraining ended at a loss of {float(losses[-1]):.3f}")

    # The plant is a blade-element quadrotor, pushed by 2 m/s² along each axis.
    plant, x0 = Scenario("large").make(), setup.flight_starts(1)[0]
    for method in ("base", "full"):
        log = fly(plant, setup.pilot(policy, method, jax.random.key(1)), x0, ticks=ticks)
        error = np.linalg.norm(log.p[-100:] - preset.goal, axis=1).mean()
        print(f"{method}: {error:.3f} m off over the last 2 s")
    for event in log.events:
        print(f"  {event.t:5.2f} s  {event.kind}: {event.note}")


if __name__ == "__main__":
    main()
