"""Computes generalised advantage estimates for PPO samples."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from retrim.learn.problem import Outcome


class Experience(NamedTuple):
    """Samples, with leading axes for steps and environments."""

    o: Float[Array, "... o"]
    action: Float[Array, "... a"]
    log_prob: Float[Array, "..."]
    value: Float[Array, "..."]
    outcome: Outcome
    """Outcomes. The reward is scaled by 1 - gamma and includes the expected future reward of a truncated episode."""


def advantages(
    experience: Experience, last: Float[Array, " envs"], discount: float, trace: float
) -> Float[Array, "steps envs"]:
    """Return the generalised advantage estimates (Schulman et al. 2016, Eq. 16).

    Args:
        experience: Samples; an episode that ends at a step does not continue at the next one.
        last: Values of the states after the last step.
        discount: The discount gamma.
        trace: The parameter lambda.
    """
    over = experience.outcome.terminated | experience.outcome.truncated

    def back(carry: Any, row: Any) -> tuple[Any, Array]:
        later, value_later = carry
        reward, over, value = row
        goes_on = jnp.where(over, 0.0, discount)
        advantage = reward + goes_on * value_later - value + goes_on * trace * later
        return (advantage, value), advantage

    rows = (experience.outcome.reward, over, experience.value)
    result: Array = lax.scan(back, (jnp.zeros_like(last), last), rows, reverse=True)[1]
    return result
