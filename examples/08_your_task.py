"""A task of your own: one file with what is seen, rewarded and measured, and one line that registers it.

You learn what a task and an observation need. The task is to stay with a goal that circles slowly; the policy sees
position and velocity relative to it. Printed are the error without and with adaptation.

The command line takes the same file: ``retrim pretrain 08_your_task:entry``, from its folder and with a name that
Python can import.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array, Bool, Float, Key

from retrim import (
    AbstractObservation,
    AbstractTask,
    Command,
    Scenario,
    Setup,
    State,
    StateObs,
    TaskEntry,
    TaskRequest,
    changed,
    fly,
    load,
    register_task,
)
from retrim.tasks import Start, huber

QUICK = {
    "pretrain": {"num_updates": 20, "num_envs": 4, "horizon": 60, "hidden_sizes": [32, 32]},
    "adapt": {"num_updates": 3, "num_envs": 4, "fit_steps": 20, "fit_every": 1.0, "update_every": 2.0},
}


def goal(t: Float[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return position [m] and velocity [m/s] of the goal: a circle of 1 m in 12 s, 1.5 m above the ground."""
    rate = 2.0 * jnp.pi / 12.0
    c, s, zero = jnp.cos(rate * t), jnp.sin(rate * t), jnp.zeros_like(t)
    return jnp.stack([c, s, zero + 1.5]), rate * jnp.stack([-s, c, zero])


class FromGoal(AbstractObservation[Array]):
    """The state relative to the goal, and the last commands."""

    state: StateObs

    @property
    def size(self) -> int:
        """Length of the observation."""
        return self.state.size

    def init(self, x: State) -> Array:
        """Return the memory at the start."""
        return self.state.init(x)

    def __call__(self, memory: Array, t: Float[Array, ""], x: State, last: Command) -> tuple[Array, Array]:
        """Return what is seen at time ``t``, and the new memory."""
        p, v = goal(t)
        return self.state(memory, t, State(x.p - p, x.R, x.v - v), last)


class Follow(AbstractTask):
    """Stay with the goal."""

    observation: FromGoal
    dt: float = eqx.field(static=True)
    horizon: int = eqx.field(static=True)

    def home(self) -> Float[Array, "3"]:
        """Return where flights start."""
        return goal(jnp.array(0.0))[0]

    def reset(self, key: Key[Array, ""]) -> Start:
        """Return a random time, and a state within 1 m of the goal at that time."""
        k_time, k_place = random.split(key)
        t = 12.0 * random.uniform(k_time)
        p, v = goal(t)
        return Start(t, State(p + random.uniform(k_place, (3,), minval=-1.0, maxval=1.0), jnp.eye(3), v))

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Reward nearness and calm."""
        p, v = goal(t)
        return -huber(5.0 * (x.p - p)) - 0.1 * huber(x.v - v) - 0.5 * huber(u.vector() - Command.hover().vector())

    def terminated(self, t: Float[Array, ""], x: State) -> Bool[Array, ""]:
        """Return whether the vehicle is lost."""
        return ~(self.error(t, x) < 5.0)  # true for NaN

    def error(self, t: Float[Array, ""], x: State) -> Float[Array, ""]:
        """Return the distance from the goal [m]."""
        return jnp.sqrt(jnp.sum((x.p - goal(t)[0]) ** 2))


def make(request: TaskRequest) -> Follow:
    """Build the task from a preset."""
    p = request.preset
    seen = FromGoal(StateObs(jnp.zeros(3), request.vehicle.omega_max, p.command_history))
    return Follow(seen, p.dt, p.pretrain.horizon)


entry = TaskEntry(make)


def main(*, quick: bool = False) -> None:
    """Register the task, train for it, and fly it."""
    register_task("follow", entry)
    preset = changed(load("hover/fast"), task="follow", **(QUICK if quick else {}))
    setup, ticks = Setup.of(preset), 100 if quick else 1500
    policy, plant, x0 = setup.pretrained(), Scenario("large").make(), setup.flight_starts(1)[0]
    for method in ("base", "full"):
        log = fly(plant, setup.pilot(policy, method, jax.random.key(1)), x0, ticks=ticks)
        error = np.asarray(jax.vmap(setup.flown.error)(jnp.asarray(log.t), log.true.as_state()))
        print(f"{method}: {error[-100:].mean():.3f} m from the goal over the last 2 s")


if __name__ == "__main__":
    main()
