"""A residual of your own: three numbers instead of a neural network, fitted in one line.

You learn that any (x, u) -> acceleration corrects a model, how flight data become its targets, and how to improve a
policy by hand: what AdaptivePilot does for you, in the open. Printed are the fitted bias, and the error before and
after.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from retrim import ControllerPilot, PolicyController, SimPlant, fly
from retrim.config import factory as build
from retrim.config import presets
from retrim.learn import PolicyState, bptt, residual_targets
from retrim.learn.pretrain import starts
from retrim.physics import BemQuadrotor, Command, Constant, Hybrid, State, small

QUICK = {"pretrain": {"epochs": 100, "envs": 8, "horizon": 100, "hidden": [32, 32]}}


class Bias(eqx.Module):
    """The same missing acceleration everywhere [m/s²]. Depend on ``x`` and ``u`` as you like."""

    a: Array

    def __call__(self, x: State, u: Command) -> Array:
        """In the state ``x`` under the command ``u``."""
        return self.a


def main(*, quick: bool = False) -> None:
    """Fly, fit, improve, fly again."""
    preset = presets.changed(presets.load("fast"), **(QUICK if quick else {}))
    policy = build.pretrained(preset)
    task, nominal = build.task(preset), build.nominal(preset)
    plant = SimPlant(BemQuadrotor.of(small(), presets.DT), Constant(jnp.array([2.0, 2.0, 2.0])))
    pilot = ControllerPilot(PolicyController(task.observation, policy))
    x0, goal, ticks = build.flight_starts(preset, 1)[0], np.array(preset.goal), 200 if quick else 500

    log = fly(plant, pilot, x0, ticks=ticks)
    print(f"before: {np.linalg.norm(log.p[-100:] - goal, axis=1).mean():.3f} m off")

    # What the model missed in each tick of the last two seconds; the best constant is its mean.
    rows = residual_targets(log.window(100), nominal, delay=preset.plant_delay)
    bias = Bias(jnp.mean(rows.a_res, axis=0))
    print(f"fitted bias: {', '.join(f'{a:.2f}' for a in bias.a.tolist())} m/s², where the push is 2 along each axis")

    # Thirty steps of back-propagation through the corrected model.
    epochs, envs = (5, 4) if quick else (30, 10)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(1e-3, epochs)))
    before = PolicyState(policy, optimiser.init(policy.params))
    x0s = starts(task, jax.random.key(1), epochs, envs)
    improve = eqx.filter_jit(bptt)
    after, losses = improve(before, Hybrid(nominal, bias), task, x0s, optimiser=optimiser, delay=preset.delay)
    print(f"improved: loss {float(losses[0]):.3f} -> {float(losses[-1]):.3f}")

    pilot.controller = PolicyController(task.observation, after.policy)  # the swap, between two ticks
    log = fly(plant, pilot, x0, ticks=ticks)
    print(f"after:  {np.linalg.norm(log.p[-100:] - goal, axis=1).mean():.3f} m off")


if __name__ == "__main__":
    main()
