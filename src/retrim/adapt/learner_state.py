"""State of an online learner, and the report of a fit."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from ..learn.bptt import PolicyState


class LearnerState(eqx.Module):
    """The learned policy and residual. They are separate, so that each can be owned by its own process."""

    policy: PolicyState
    residual: Any
    """State of the residual model: a pytree of arrays."""


class FitReport(eqx.Module):
    """Result of a residual fit."""

    rms_error: Float[Array, ""]
    """Root mean square of the error over the window [m/s^2]."""
    accepted: Bool[Array, ""]
    """False if the fit is not finite or no tick of the window could be used; the old state is then kept."""
    contradictions: Int[Array, "5"]
    """Number of window steps that were left out, by reason; see :class:`~retrim.learn.screening.Screening`."""
