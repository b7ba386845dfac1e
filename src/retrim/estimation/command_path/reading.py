"""Represent the reading of one sensor in a tick."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .channel import Sample


class Reading(NamedTuple):
    """Reading of one sensor in a tick."""

    value: Float[Array, " axes"]
    usable: Bool[Array, ""]
    kinds: tuple[tuple[float, float, float], ...]
    """Possible kinds of noise."""
    age: Float[Array, ""]
    """Age of the reading [s]."""
    width: float
    """Length of the averaging interval [s]."""

    def sample(self, axes: slice, other: Float[Array, "axes n"]) -> Sample:
        """Return the sample for some axes, with their further features."""
        value, dtype = self.value[axes], self.age.dtype
        width = jnp.full((), self.width, dtype)
        usable = self.usable & jnp.all(jnp.isfinite(value))
        return Sample(value, other, usable, jnp.array(self.kinds, dtype), self.age, width)
