"""Task: hover relative to a goal on a circle. `retrim pretrain moving_goal:task`."""

import jax.numpy as jnp

import retrim


def goal(t):
    return jnp.stack([jnp.cos(0.5 * t), jnp.sin(0.5 * t), 1.5 + 0.0 * t])


def task(request: retrim.TaskRequest) -> retrim.AbstractTask:
    return request.hover(goal=goal)
