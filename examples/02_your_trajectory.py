"""A trajectory of your own, as a Python function or as a CSV file, is flown by a policy that never saw it.

You learn to make a reference, to ask whether a vehicle can fly it, and that one policy, trained on circle, figure 8 and
star, flies others too. Printed are the check, and the tracking error in wind. For a fast vehicle there is race.csv, a
loop through gates at the limits of the kingfisher: `retrim reproduce fast --references examples/race.csv`.
"""

import math
import tempfile
from pathlib import Path

import jax
import numpy as np

from retrim import Reference, Scenario, Setup, changed, fly, from_csv, load
from retrim.tasks import smooth_start

QUICK = {
    "track": {"reference": "circle", "gravity_copies": 0},
    "pretrain": {"num_updates": 20, "num_envs": 4, "horizon": 40, "hidden_sizes": [32, 32]},
    "adapt": {"window": 50, "num_updates": 2, "num_envs": 3},
}


def climb(t: float) -> list[float]:
    """Return x, y, z [m] and the heading [rad] of a Lissajous figure that rises by 1 m while the nose sways."""
    phase = 2.0 * math.pi * smooth_start(t) / 8.0  # a lap of 8 s, after a smooth start
    return [math.sin(phase), 0.7 * math.sin(2.0 * phase), 1.5 - 0.5 * math.cos(phase), 0.5 * math.sin(phase)]


def main(*, quick: bool = False) -> None:
    """Train on the family, and fly what is not in it."""
    preset = changed(load("track/retrim"), **(QUICK if quick else {}))
    mine = Reference.of(climb, seconds=11.0, lap=3.0)  # from 3 s on it repeats
    hasty = Reference.of(lambda t: climb(3.0 * t), seconds=11.0 / 3.0, lap=1.0)
    setup = Setup.from_preset(preset, mine)  # trains on the preset's references, flies mine
    print(f"Can the small quadrotor fly it? {setup.limits_exceeded() or 'yes'}")
    print(f"Three times as fast? {hasty.infeasibility(setup.vehicle) or 'yes'}")

    policy = setup.pretrained()
    plant, x0, ticks = Scenario("wind=3").make(), setup.flight_starts(1)[0], 100 if quick else 1500

    def error(setup: Setup, method: str) -> float:
        """Fly; return the mean distance over the last 8 s from where the vehicle should have been [m]."""
        log = fly(plant, setup.pilot(policy, method, jax.random.key(1)), x0, ticks=ticks)
        return float(jax.vmap(setup.flight_task.error)(jax.numpy.asarray(log.t), log.true.as_state())[-400:].mean())

    print(f"the climb in 3 m/s of wind, as it is: {error(setup, 'base'):.3f} m off")
    print(f"adapted in flight:                    {error(setup, 'full'):.3f} m off")

    # The same as points in a file, one every quarter of a second: t, x, y, z, yaw.
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "climb.csv"
        rows = [f"{t},{','.join(f'{value:.5f}' for value in climb(t))}" for t in np.arange(0.0, 11.01, 0.25)]
        file.write_text("\n".join(["t,x,y,z,yaw", *rows]))
        filed = Setup.from_preset(preset, from_csv(file))
    print(f"from the file, as it is:              {error(filed, 'base'):.3f} m off")


if __name__ == "__main__":
    main()
