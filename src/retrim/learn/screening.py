"""Screen a window for contradictory measurements, and find the ticks that a learner can use."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..estimation.consistency import Findings, Scale, contradictions, gap, gap_noise
from ..physics.state import State
from .window import Window


class Screening(eqx.Module):
    """Result of a screening. A window of n measurements has n - 1 steps."""

    steps: Bool[Array, " steps"]
    """Steps from one measurement to the next that pass all tests; steps of invalid ticks, and steps that are not one
    tick long, are not tested."""
    samples: Bool[Array, " n"]
    """Measurements at either end of at least one such step."""
    counts: Int[Array, "5"]
    """Number of contradicted steps by reason, in the order of :class:`~retrim.estimation.consistency.Findings`."""
    trusted: Bool[Array, ""]
    """True if at least half of the steps are usable, and the velocities match the scale of the positions."""

    def note(self) -> str:
        """Return the reasons and their counts in words; return an empty string if there are no contradictions."""
        return describe_counts(self.counts)


REASONS = (
    "repeated",
    "velocity is not the derivative of position",
    "acceleration out of range",
    "attitude out of range",
    "not finite",
)


def describe_counts(counts: Int[ArrayLike, "5"] | Sequence[int]) -> str:
    """Return the reasons with their counts in words; return an empty string if all are zero."""
    result = zip(REASONS, np.asarray(counts, dtype=int).tolist(), strict=False)
    return ", ".join(f"{name}: {n}" for name, n in result if n)


def screen(window: Window, dt: float) -> Screening:
    """Return which measurements of a window are usable for learning.

    The noise of the flight is a median over its steps, so up to half of them may be corrupted. The step after a
    repeated measurement contains the motion of two ticks, so it does not count either.

    Args:
        window: Ticks of flight.
        dt: Control tick [s].
    """
    before, after = (_rows(window.x, part) for part in (slice(None, -1), slice(1, None)))
    stamps = window.t if window.age is None else window.t - window.age
    successive = jnp.abs(jnp.diff(stamps) - dt) < 0.25 * dt
    valid = window.valid[:-1] & window.valid[1:] & successive
    gaps = jax.vmap(lambda a, b: gap(a, b, dt))(before, after)
    noise = _median(jax.vmap(gap_noise)(gaps[:-1], gaps[1:]), valid[:-1] & valid[1:])
    result: Findings = jax.vmap(lambda a, b: contradictions(a, b, dt, noise))(before, after)
    stale = jnp.concatenate([jnp.zeros(1, dtype=bool), result.repeated[:-1]])
    bad = result.any | stale
    moments = jax.vmap(lambda missing, a, b: Scale.of(missing, 0.5 * (a.v + b.v), dt))(gaps, before, after)
    n = jnp.maximum(jnp.sum(valid & ~bad), 1).astype(noise.dtype)
    scale = jax.vmap(lambda good, each: jax.tree.map(lambda leaf: jnp.where(good, leaf, 0.0), each))(
        valid & ~bad, moments
    )
    shows, wrong = jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0) / n, scale).verdict(dt, noise)
    counts = jnp.stack([jnp.sum(leaf & valid) for leaf in jax.tree.leaves(result)])
    good, nothing = valid & ~bad, jnp.zeros(1, dtype=bool)
    beside = jnp.concatenate([nothing, good]) | jnp.concatenate([good, nothing])
    checks = jnp.concatenate([nothing, valid]) | jnp.concatenate([valid, nothing])
    samples = window.valid & (beside | ~checks)
    usable = ~(shows & wrong) & (jnp.sum(bad & valid) <= jnp.sum(valid) // 2)  # learn only from a good majority
    return Screening(~(bad & valid), samples, counts, usable)


def _rows(x: State, part: slice) -> State:
    return jax.tree.map(lambda leaf: leaf[part], x)  # type: ignore[no-any-return]


def _median(values: Float[Array, " n"], counts: Bool[Array, " n"]) -> Float[Array, ""]:
    """Return the median of the values that count; return zero if no value counts."""
    order = jnp.sort(jnp.where(counts & jnp.isfinite(values), values, jnp.inf))
    middle = order[(jnp.sum(counts) - 1) // 2]  # the last value, which is infinite, if the count is zero
    return jnp.where(jnp.isfinite(middle), middle, 0.0)
