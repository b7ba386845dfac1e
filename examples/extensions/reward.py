"""Reward: hover with cheap thrust and expensive body rates. `retrim pretrain reward:task`."""

import jax.numpy as jnp

import retrim


def reward(goal, x, u):
    error = jnp.sqrt(jnp.sum((x.p - goal) ** 2) + 0.01)
    return -5.0 * error - 0.2 * jnp.sum(x.v**2) - 0.1 * jnp.sum(u.omega**2)


def task(request: retrim.TaskRequest) -> retrim.AbstractTask:
    return request.hover(reward=reward)
