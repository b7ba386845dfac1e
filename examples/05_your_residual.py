"""A residual model of your own: three numbers instead of neural networks, in the same loop.

You learn the four methods that a residual model needs, and to put it into a set-up; the learner then corrects its
simulator with it. Printed are the hover error without and with adaptation, and the bias that was learnt.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from retrim import Command, Scenario, Setup, State, Targets, changed, fly, load

QUICK = {
    "pretrain": {"num_updates": 20, "num_envs": 4, "horizon": 60, "hidden_sizes": [32, 32]},
    "adapt": {"num_updates": 3, "num_envs": 4, "fit_steps": 20, "fit_every": 1.0, "update_every": 2.0},
}


class Bias(eqx.Module):
    """The same acceleration is missing everywhere; its state is mean and standard deviation per axis [m/s²]."""

    def init(self, key: Key[Array, ""]) -> tuple[Array, Array]:
        """Predict nothing before the first fit."""
        return jnp.zeros(3), jnp.zeros(3)

    def fit(self, state: tuple[Array, Array], rows: Targets) -> tuple[tuple[Array, Array], Array]:
        """Take mean and spread of the rows that count; also return the error that is left [m/s²]."""
        weight = (rows.valid / jnp.maximum(rows.valid.sum(), 1))[:, None].astype(rows.a_res.dtype)
        mean = jnp.sum(weight * rows.a_res, axis=0)
        std = jnp.sqrt(jnp.sum(weight * (rows.a_res - mean[None]) ** 2, axis=0))
        return (mean, std), jnp.sqrt(jnp.sum(std**2))

    def predict(self, state: tuple[Array, Array], x: State, u: Command) -> Array:
        """Return the mean; depend on ``x`` and ``u`` as you like."""
        return state[0]

    def spread(self, state: tuple[Array, Array], x: State, u: Command) -> Array:
        """Return the standard deviation."""
        return state[1]


def main(*, quick: bool = False) -> None:
    """Adapt with the bias instead of the ensemble."""
    preset = changed(load("hover/fast"), **(QUICK if quick else {}))
    setup, ticks = Setup.of(preset, residual_model=Bias()), 100 if quick else 1500
    policy, x0 = setup.pretrained(), setup.flight_starts(1)[0]
    for method in ("base", "full"):
        pilot = setup.pilot(policy, method, jax.random.key(1))
        log = fly(Scenario("large").make(), pilot, x0, ticks=ticks)
        error = np.linalg.norm(log.p[-100:] - preset.goal, axis=1).mean()
        print(f"{method}: {error:.3f} m off over the last 2 s")
    mean, _ = pilot.state.residual
    print(f"learnt: {', '.join(f'{a:.2f}' for a in mean.tolist())} m/s², where the push is 2 along each axis")


if __name__ == "__main__":
    main()
