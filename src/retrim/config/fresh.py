"""What a set-up draws from a seed beside training: fresh policies, starts of flights, and deltas of low rank."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array, Float, Key

from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..physics.state import State
from ..physics.vehicle import Vehicle
from ..tasks.hover import TILT, Hover
from ..tasks.observation import StateObs

START_TAG = 2**30 + 1  # folded into a seed for the starts of flights: they share no key with training
LOW_RANK_TAG = 2**30 + 4  # folded into a learner's key for the delta that it starts from


@partial(jax.jit, static_argnames=("size", "hidden"))
def untrained(size: int, vehicle: Vehicle, key: Key[Array, ""], hidden: tuple[int, ...]) -> Policy:
    """Return a policy of observations of a size, by a program that every set-up of these sizes shares.

    Args:
        size: Of the observation.
        vehicle: It gives the limits of the commands.
        key: Consumed.
        hidden: Widths of the hidden layers.
    """
    return Policy.of(size, vehicle, key=key, hidden=hidden)


def flight_starts(home: Float[Array, "3"], n: int, seed: int) -> list[State]:
    """Return ``n`` starts: +- 1 m per axis from ``home``, 18 degrees about each axis, 0.1 m/s.

    Args:
        home: World frame [m].
        n: How many.
        seed: The same seed gives the same starts.
    """
    batch = _starts(home, random.fold_in(random.key(seed), START_TAG), n)
    return [jax.tree.map(lambda leaf, i=i: jax.device_put(np.asarray(leaf)[i]), batch) for i in range(n)]


def low_rank(policy: Policy | LoraPolicy, key: Key[Array, ""]) -> LoraPolicy:
    """Return ``policy`` with a fresh low-rank delta, unless it has one.

    Args:
        policy: Full policy, or one with a delta.
        key: That of the learner.

    Raises:
        ValueError: The policy has other than three layers, or one too narrow for its rank.
    """
    if isinstance(policy, LoraPolicy):
        return policy
    fresh: LoraPolicy = _low_rank(policy, random.fold_in(key, LOW_RANK_TAG))
    return fresh


@jax.jit
def _low_rank(policy: Policy, key: Key[Array, ""]) -> LoraPolicy:
    return LoraPolicy.of(policy, key=key)


@partial(jax.jit, static_argnames="n")
def _starts(home: Float[Array, "3"], key: Key[Array, ""], n: int) -> State:
    nearby = Hover(home, StateObs(home, jnp.ones_like(home), 0), jnp.array(1.0), jnp.array(TILT))
    drawn: State = jax.vmap(nearby.reset)(random.split(key, n)).x
    return drawn
