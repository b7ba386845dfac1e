"""A vehicle of your own: a file of what a builder can measure, trained for and flown with wind and a payload.

You learn to describe a vehicle, and to check its description: at hover thrust it should neither rise nor fall by much.
Printed are thrust-to-weight ratio and hover check, and the hover error without and with adaptation.
"""

from pathlib import Path

import jax
import numpy as np

from retrim import Command, FunctionPilot, Scenario, Setup, changed, fly, load, read_vehicle

QUICK = {
    "pretrain": {"num_updates": 20, "num_envs": 4, "horizon": 60, "hidden_sizes": [32, 32]},
    "adapt": {"num_updates": 3, "num_envs": 4, "fit_steps": 20, "fit_every": 1.0, "update_every": 2.0},
}
FILE = Path(__file__).with_name("seven_inch.toml")


def main(*, quick: bool = False) -> None:
    """Check the vehicle, train for it, and fly it."""
    preset = changed(load("hover/fast"), vehicle=read_vehicle(FILE), **(QUICK if quick else {}))
    setup, ticks = Setup.of(preset), 100 if quick else 1500
    x0 = setup.flight_starts(1)[0]

    level = fly(Scenario().make(preset.vehicle), FunctionPilot(lambda measurement: Command.hover()), x0, ticks=25)
    rise, ratio = (level.v[-1, 2] - level.v[0, 2]) / level.t[-1], float(setup.vehicle.command_max.c) / 9.81
    print(f"{preset.vehicle.name}: thrust {ratio:.1f} times its weight; {rise:+.2f} m/s² at hover thrust")

    policy, plant = setup.pretrained(), Scenario("wind=5+payload=0.2").make(preset.vehicle)
    for method in ("base", "full"):
        log = fly(plant, setup.pilot(policy, method, jax.random.key(1)), x0, ticks=ticks)
        error = np.linalg.norm(log.p[-100:] - preset.goal, axis=1).mean()
        print(f"{method}: {error:.3f} m off with 200 g of load in 5 m/s of wind")


if __name__ == "__main__":
    main()
