"""The state and the disturbance that an observation estimates in flight."""

from typing import NamedTuple

from jaxtyping import Array, Float

from ..physics.state import State


class StateEstimate(NamedTuple):
    """Estimate from the measurements of an observation, such as images, without the measured state."""

    x: State
    """Estimated state."""
    d: Float[Array, "3"]
    """Estimated disturbance, world [m/s^2]; zero if it is not estimated."""
