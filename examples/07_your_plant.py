"""A plant of your own: three methods connect a simulator or a vehicle to retrim; here it is a toy in NumPy.

You learn what reset, step and stop must do. The toy's body rates lag behind the command, air drags on it, and something
pulls it sideways; no pilot is told. Printed are the hover error without and with adaptation, and the events.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from retrim import Command, Measurement, Plant, PlantError, Setup, State, as_numpy, changed, check_command, fly, load

QUICK = {
    "pretrain": {"num_updates": 20, "num_envs": 4, "horizon": 60, "hidden_sizes": [32, 32]},
    "adapt": {"num_updates": 3, "num_envs": 4, "fit_steps": 20, "fit_every": 1.0, "update_every": 2.0},
}


class Toy(Plant):
    """A point that accelerates along its thrust axis, in steps of 2 ms."""

    dt = 0.02

    def reset(self, x0: State | None) -> Measurement:
        """Start at rest in ``x0``; a vehicle would wait for its first measurement."""
        x = State.at(jnp.array([0.0, 0.0, 1.0])) if x0 is None else x0
        self._p, self._R, self._v = (np.array(leaf, dtype=float) for leaf in (x.p, x.R, x.v))
        self._rates, self._ticks, self._flying = np.zeros(3), 0, True
        return Measurement(0.0, x)

    def step(self, u: Command) -> tuple[Measurement, Command]:
        """Fly one tick. On hardware: send ``u``, and wait for the next measurement."""
        check_command(u, "Toy")  # a command that is not finite never reaches the vehicle
        if not self._flying:
            raise PlantError("Toy: not flying; call reset first")
        h, (c, *rates) = 0.002, as_numpy(u)
        for _ in range(10):
            self._rates += h / 0.03 * (np.array(rates) - self._rates)  # 30 ms of lag
            self._R = self._R @ Rotation.from_rotvec(h * self._rates).as_matrix()
            a = self._R[:, 2] * c + np.array([1.0, -1.5, -9.81 + 0.5]) - 0.3 * self._v
            self._p, self._v = self._p + h * self._v, self._v + h * a
        self._ticks += 1
        return Measurement(self._ticks * self.dt, State(*map(jnp.array, (self._p, self._R, self._v)))), u

    def stop(self) -> None:
        """Leave the vehicle safe; this is called at the end of every flight, also after an error."""
        self._flying = False


def main(*, quick: bool = False) -> None:
    """Fly the toy with a policy that was trained without it."""
    # The toy acts at once: it has no delay of commands to declare, only lag.
    preset = changed(load("hover/fast"), plant_delay_ticks=0, **(QUICK if quick else {}))
    setup, ticks = Setup.of(preset), 100 if quick else 1500
    policy, x0 = setup.pretrained(), setup.flight_starts(1)[0]
    for method in ("base", "full"):
        log = fly(Toy(), setup.pilot(policy, method, jax.random.key(1)), x0, ticks=ticks)
        error = np.linalg.norm(log.p[-100:] - preset.goal, axis=1).mean()
        print(f"{method}: {error:.3f} m off over the last 2 s")
    for event in log.events[:4]:
        print(f"  {event.t:5.2f} s  {event.kind}: {event.note}")


if __name__ == "__main__":
    main()
