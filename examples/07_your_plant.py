"""A plant of your own: three methods connect a simulator or a vehicle to retrim; here it is a toy in NumPy.

You learn what reset, exchange and stop must do. The toy's body rates lag behind the command, air drags on it, and
something pulls it sideways; no pilot is told. Printed are the hover error without and with adaptation, and the events.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from retrim import Command, ControllerPilot, Measurement, PolicyController, State, fly
from retrim.config import factory as build
from retrim.config import presets
from retrim.plants.plant import PlantError, check_command

QUICK = {
    "pretrain": {"epochs": 100, "envs": 8, "horizon": 100, "hidden": [32, 32]},
    "adapt": {"epochs": 3, "envs": 4, "iters": 20, "refine_every": 1.0, "improve_every": 2.0},
}


class Toy:
    """A point that accelerates along its thrust axis, in steps of 2 ms."""

    dt = presets.DT

    def __init__(self) -> None:
        self._flying = False

    def reset(self, x0: State | None) -> Measurement:
        """At rest at ``x0``; the first sample has the time zero, by which pilots know that a flight begins."""
        x = State.at(jnp.array([0.0, 0.0, 1.0])) if x0 is None else x0
        self._p, self._R, self._v = (np.array(leaf, dtype=float) for leaf in (x.p, x.R, x.v))
        self._rates, self._ticks, self._flying = np.zeros(3), 0, True
        return Measurement(0.0, x, Command.hover())

    def step(self, u: Command) -> Measurement:
        """One tick. On hardware: send ``u``, wait for the next measurement."""
        check_command(u, "Toy")  # a command that is not finite never reaches the vehicle
        if not self._flying:
            raise PlantError("Toy: not flying; call reset first")
        h, c, commanded = 0.002, float(u.c), np.asarray(u.omega)
        for _ in range(10):
            self._rates += h / 0.03 * (commanded - self._rates)  # 30 ms of lag
            self._R = self._R @ Rotation.from_rotvec(h * self._rates).as_matrix()
            a = self._R[:, 2] * c + np.array([1.0, -1.5, -9.81 + 0.5]) - 0.3 * self._v
            self._p, self._v = self._p + h * self._v, self._v + h * a
        self._ticks += 1
        return Measurement(self._ticks * self.dt, State(*map(jnp.array, (self._p, self._R, self._v))), u)

    def stop(self) -> None:
        """Leave the vehicle safe; called at the end of every flight, also after an error."""
        self._flying = False


def main(*, quick: bool = False) -> None:
    """Fly the toy with a policy that was trained without it."""
    # The toy acts at once: it has no delay of commands to declare, only lag.
    preset = presets.changed(presets.load("fast"), plant_delay=0, **(QUICK if quick else {}))
    policy = build.pretrained(preset)
    x0, goal, ticks = build.flight_starts(preset, 1)[0], np.array(preset.goal), 250 if quick else 1500

    log = fly(Toy(), ControllerPilot(PolicyController(build.seen_in_flight(preset), policy)), x0, ticks=ticks)
    print(f"without adaptation: {np.linalg.norm(log.p[-100:] - goal, axis=1).mean():.3f} m off")

    pilot = build.pilot(preset, policy, jax.random.key(1))
    log = fly(Toy(), pilot, x0, ticks=ticks)
    print(f"with adaptation:    {np.linalg.norm(log.p[-100:] - goal, axis=1).mean():.3f} m off")
    for event in pilot.events[:4]:
        print(f"  {event.t:5.2f} s  {event.kind}: {event.note}")


if __name__ == "__main__":
    main()
