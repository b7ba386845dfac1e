"""References that a user may select in flight."""

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..config.references import make_reference
from ..config.setup import Setup
from ..tasks.abstract_reference import AbstractReference
from ..tasks.reference import Reference
from ..tasks.shapes import REFERENCES


def choices(setup: Setup, present: str) -> tuple[str, ...]:
    """Return the names of the references that a user may select in flight, with the current one first.

    The result is empty if the policy does not observe its reference: such a policy cannot follow a different reference.
    It is also empty in a paced flight, whose reference does not follow the flight time.

    Args:
        setup: Set-up of the flight.
        present: Name of the current reference.
    """
    if setup.pace is not None:
        return ()
    leaves = jax.tree.leaves(setup.flight_task.observation_in_flight, is_leaf=lambda part: isinstance(part, Reference))
    if not any(isinstance(part, Reference) for part in leaves):
        return ()
    return (present, *(name for name in REFERENCES if name != present))


def paths(names: Sequence[str], seconds: float) -> Mapping[str, np.ndarray]:
    """Return the positions along each reference over ``seconds`` in the world frame [m], (n, 3), by name."""
    times = jnp.arange(0.0, seconds, 0.05)
    return {name: np.asarray(_places(make_reference(name), times), dtype=float) for name in names}


@eqx.filter_jit
def _places(reference: AbstractReference, times: Float[Array, " n"]) -> Float[Array, "n 3"]:
    return jax.vmap(lambda t: reference(t).p)(times)
