"""Draw the random objects of a set-up outside training: untrained policies, flight starts, and low-rank deltas."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array, Float, Key

from ..control.lora import LoraPolicy
from ..control.policy import AbstractPolicy, Policy
from ..physics.state import State
from ..physics.vehicle import Vehicle
from ..tasks.hover import Hover
from ..tasks.observation import StateObs
from ..tasks.task import TILT

START_TAG = 2**30 + 1  # folded into the seed of flight starts, to keep their keys different from training keys
LOW_RANK_TAG = 2**30 + 4  # folded into the key of a learner, for its initial delta


@partial(jax.jit, static_argnames=("size", "hidden"))
def make_untrained_policy(size: int, vehicle: Vehicle, key: Key[Array, ""], hidden: tuple[int, ...]) -> Policy:
    """Return an untrained policy; set-ups with the same sizes share a compiled program.

    Args:
        size: Size of the observation.
        vehicle: Vehicle with the command limits.
        key: Random key; consumed.
        hidden: Widths of the hidden layers.
    """
    return Policy.of(size, vehicle, key=key, hidden=hidden)


def flight_starts(home: Float[Array, "3"], n: int, seed: int) -> list[State]:
    """Return ``n`` starts within ±1 m of ``home`` and ±18 degrees per axis, with velocities of about 0.1 m/s per axis.

    Args:
        home: Centre of the starts, world [m].
        n: Number of starts.
        seed: Seed; the same seed gives the same starts.
    """
    batch = _starts(home, random.fold_in(random.key(seed), START_TAG), n)
    return [jax.tree.map(lambda leaf, i=i: jax.device_put(np.asarray(leaf)[i]), batch) for i in range(n)]


def low_rank(policy: AbstractPolicy | LoraPolicy, key: Key[Array, ""]) -> LoraPolicy:
    """Return ``policy`` with a new low-rank delta, unless ``policy`` already has a delta.

    Args:
        policy: Full policy, or one with a delta.
        key: Key of the learner.

    Raises:
        ValueError: The policy is not a perceptron with three layers, or a layer is too narrow for its rank.
    """
    if isinstance(policy, LoraPolicy):
        return policy
    if not isinstance(policy, Policy):
        raise ValueError("low-rank adaptation needs a perceptron, pretrain.network = 'mlp'")
    fresh: LoraPolicy = _low_rank(policy, random.fold_in(key, LOW_RANK_TAG))
    return fresh


@jax.jit
def _low_rank(policy: Policy, key: Key[Array, ""]) -> LoraPolicy:
    return LoraPolicy.of(policy, key=key)


@partial(jax.jit, static_argnames="n")
def _starts(home: Float[Array, "3"], key: Key[Array, ""], n: int) -> State:
    nearby = Hover(home, StateObs(home, jnp.ones_like(home), 0), jnp.array(1.0), jnp.array(TILT))
    states: State = jax.vmap(nearby.reset)(random.split(key, n)).x
    return states
