"""A trajectory of your own, as a Python function or as a CSV file, flown by a policy that never saw it.

You learn to make a reference, to check whether a vehicle can fly it, and that one policy, trained on circle, figure 8
and star, flies others too. Printed are the check, and the tracking error without and with adaptation in wind.
"""

import math
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from retrim import ControllerPilot, Log, PolicyController, SimPlant, fly
from retrim.config import factory as build
from retrim.config import presets
from retrim.physics import BemQuadrotor, SteadyWind, small
from retrim.tasks import Reference, from_csv
from retrim.tasks.reference import smooth_start

QUICK = {
    "reference": "circle",
    "pretrain": {"epochs": 100, "envs": 8, "horizon": 60, "hidden": [32, 32]},
    "adapt": {"window": 100, "epochs": 3, "envs": 4, "iters": 20, "refine_every": 1.0, "improve_every": 2.0},
}


def climb(t: float) -> list[float]:
    """A Lissajous figure that rises by 1 m and comes down again, the nose swaying: x, y, z [m], heading [rad]."""
    phase = 2.0 * math.pi * smooth_start(t) / 8.0  # a lap of 8 s, after a smooth start
    return [math.sin(phase), 0.7 * math.sin(2.0 * phase), 1.5 - 0.5 * math.cos(phase), 0.5 * math.sin(phase)]


def error(log: Log, reference: Reference) -> float:
    """Mean distance over the last lap from where the vehicle should have been [m]."""
    wanted = jax.vmap(reference)(jnp.asarray(log.t)).p
    return float(np.linalg.norm(log.p - np.asarray(wanted), axis=1)[-400:].mean())


def main(*, quick: bool = False) -> None:
    """Train on the family, fly what is not in it."""
    preset = presets.changed(presets.load("track"), **(QUICK if quick else {}))
    mine = Reference.of(climb, seconds=11.0, lap=3.0)  # from 3 s on it repeats
    print(f"can the small quadrotor fly it? {mine.worst_violation(small()) or 'yes'}")
    hasty = Reference.of(lambda t: climb(3.0 * t), seconds=11.0 / 3.0, lap=1.0, points=256)
    print(f"three times as fast? {hasty.worst_violation(small()) or 'yes'}")

    for trained, losses in build.pretraining(preset):  # after every ten epochs
        policy = trained
        print(f"pretraining: loss {float(losses[-1]):.3f}", end="\r")
    print()

    plant = SimPlant(BemQuadrotor.of(small(), presets.DT), SteadyWind(jnp.array([3.0, 0.0, 0.0])))
    ticks = 250 if quick else 1500
    x0 = build.flight_starts(preset, 1, flown=mine)[0]
    pilot = ControllerPilot(PolicyController(build.seen_in_flight(preset, mine), policy))
    print(f"the climb in 3 m/s of wind, not adapted: {error(fly(plant, pilot, x0, ticks=ticks), mine):.3f} m off")

    pilot = build.pilot(preset, policy, jax.random.key(1), flown=mine)  # re-trains on what is flown
    print(f"adapted in flight:                       {error(fly(plant, pilot, x0, ticks=ticks), mine):.3f} m off")

    # The first ten seconds as points in a file, one every half second: t, x, y, z, heading.
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "climb.csv"
        file.write_text(
            "t,x,y,z,yaw\n" + "".join(f"{t},{','.join(map(str, climb(t)))}\n" for t in np.arange(0, 11, 0.5))
        )
        filed = from_csv(file)
    pilot = ControllerPilot(PolicyController(build.seen_in_flight(preset, filed), policy))
    off = error(fly(plant, pilot, x0, ticks=min(ticks, 500)), filed)
    print(f"from the file, ten seconds, not adapted: {off:.3f} m off")


if __name__ == "__main__":
    main()
