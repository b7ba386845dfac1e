"""Convert states to and from NumPy vectors that contain p, R by rows and v, for exchange between processes."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ..physics.state import State


def vector_of(x: State) -> np.ndarray:
    """Return a state as a vector without running a JAX program."""
    return np.concatenate([np.asarray(leaf, dtype=float).ravel() for leaf in (x.p, x.R, x.v)])


def state_of(x: np.ndarray, dtype: Any) -> State:
    """Return the state that a vector contains."""
    p, R, v = (jnp.asarray(part, dtype) for part in (x[:3], x[3:12].reshape(3, 3), x[12:]))
    return State(p, R, v)
