"""Flying from pixels: the policy sees seven points on the ground through a camera, and never its own state.

You learn that such a policy first learns to see and then to fly, and that what it sees in flight may differ from
what it saw in training: here points out of sight are not observed, pixels are noisy, and some points are missed.
Printed are both trainings, and the hover error in wind without and with adaptation.
"""

import jax
import jax.numpy as jnp
import numpy as np

from retrim import AdaptivePilot, ControllerPilot, Log, PolicyController, SimPlant, build, fly, presets, pretrain
from retrim.learn.represent import represent
from retrim.physics import Bem, SteadyWind, small

QUICK = {
    "represent": 100,
    "pretrain": {"epochs": 20, "envs": 4, "horizon": 60, "hidden": [32, 32]},
    "adapt": {"epochs": 2, "envs": 2, "iters": 20, "refine_every": 1.0, "improve_every": 1.5, "improve_charge": 0.5},
}


def error(log: Log, goal: tuple[float, float, float]) -> float:
    """Mean distance from the goal over the last two seconds [m]."""
    return float(np.linalg.norm(log.p[-100:] - np.array(goal), axis=1).mean())


def main(*, quick: bool = False) -> None:
    """Learn to see, learn to fly, fly in wind."""
    preset = presets.changed(presets.load("vision-honest"), **(QUICK if quick else {}))
    policy = build.policy(preset, jax.random.key(0))

    # To see: predict position, attitude and velocity from the pixels of random motions. No flight is needed.
    policy, errors = represent(policy, build.keypoints(preset), jax.random.key(1), steps=preset.represent)
    print(f"learnt to see: error of the state {float(errors[0]):.2f} -> {float(errors[-1]):.2f} (scaled)")

    # To fly: as in 01_hover.py. In training every point is fed, seen or not.
    training = pretrain(
        policy,
        build.nominal(preset),
        build.task(preset),
        jax.random.key(2),
        optimiser=build.optimiser(preset),
        epochs=preset.pretrain.epochs,
        envs=preset.pretrain.envs,
        delay=preset.delay,
    )
    losses = []
    for state, chunk in training:  # after every ten epochs
        policy = state.policy
        losses.extend(chunk.tolist())
    print(f"learnt to fly: loss {losses[0]:.2f} -> {losses[-1]:.2f}")

    # In flight only what the camera sees is observed; a filter of the pose fills in the rest.
    honest = build.seen_in_flight(preset)
    plant = SimPlant(Bem.of(small(), presets.DT), SteadyWind(jnp.array([2.0, 2.0, 0.0])))
    x0, ticks = build.flight_starts(preset, 1)[0], 150 if quick else 1500
    base = ControllerPilot(PolicyController(honest, policy))
    print(f"in 2.8 m/s of wind, not adapted: {error(fly(plant, base, x0, ticks=ticks), preset.goal):.3f} m off")

    adapter = build.adapter(preset)
    pilot = AdaptivePilot(
        adapter,
        adapter.init(policy, build.residual(preset, jax.random.key(3))),
        build.schedule(preset),
        jax.random.key(4),
        dt=presets.DT,
        window=preset.adapt.window,
        observation=honest,
    )
    print(f"adapted in flight:               {error(fly(plant, pilot, x0, ticks=ticks), preset.goal):.3f} m off")


if __name__ == "__main__":
    main()
