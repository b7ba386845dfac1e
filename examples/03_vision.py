"""Fly from pixels: the policy observes seven points on the ground through a camera, and not the state.

Training begins with an encoder and continues with the policy. In flight, the observation may differ from that of
training: here, points outside the image are not observed, pixels are noisy, and some points are missed. A filter
estimates the pose and the disturbance from the remaining points. The example prints the training loss and the hover
error in wind: of the policy alone, of the policy in the frame of effective gravity, and with adaptation.
"""

import jax
import numpy as np

from retrim import Scenario, Setup, changed, fly, load

QUICK = {
    "vision": {"encoder_steps": 10},
    "pretrain": {"num_updates": 20, "num_envs": 4, "horizon": 40, "hidden_sizes": [32, 32]},
    "adapt": {"num_updates": 2, "num_envs": 3, "window": 50},
}


def main(*, quick: bool = False) -> None:
    """Learn to see, learn to fly, and fly in wind."""
    preset = changed(load("vision/retrim"), **(QUICK if quick else {}))
    setup, ticks = Setup.from_preset(preset), 100 if quick else 1500
    # First, the encoder learns to predict position, attitude and velocity from the pixels of random motions.
    *_, (policy, losses) = setup.pretraining()
    print(f"pretraining ended at a loss of {float(losses[-1]):.3f}")

    # In flight, only points in the image are observed; the policy receives the image of the estimated pose.
    plant, x0 = Scenario("wind=3").make(), setup.flight_starts(1)[0]
    for method in ("base", "base-do", "full"):
        log = fly(plant, setup.pilot(policy, method, jax.random.key(1)), x0, ticks=ticks)
        error = np.linalg.norm(log.p[-100:] - preset.goal, axis=1).mean()
        print(f"{method}: {error:.3f} m off in 3 m/s of wind")


if __name__ == "__main__":
    main()
