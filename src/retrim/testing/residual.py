"""Conformance suite for residual models."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import random

from ..learn.residuals.model import ResidualModel
from ..learn.residuals.targets import Targets
from ..physics.state import STANDARD_GRAVITY, Command, State
from .laws import close, require, shapes


def check_residual(model: ResidualModel, *, fits: int = 5, tolerance: float = 0.5) -> None:
    """Check a residual model.

    Args:
        model: Residual model to check.
        fits: Number of fits after which the model must have learned a constant acceleration.
        tolerance: Largest error of the model's prediction after the fits, as a fraction of the acceleration.

    Raises:
        AssertionError: A law is broken.
    """
    require(isinstance(model, ResidualModel), "it has init, fit and predict")
    key, n = random.key(0), 60
    k_p, k_v, k_u, k_init = random.split(key, 4)
    p, v = (0.3 * random.normal(k, (n, 3)) for k in (k_p, k_v))
    x = jax.vmap(State)(p + jnp.array([[0.0, 0.0, 1.0]]), jnp.broadcast_to(jnp.eye(3), (n, 3, 3)), v)
    rates = 0.3 * random.normal(k_u, (n, 3))
    u = jax.vmap(Command)(jnp.full(n, STANDARD_GRAVITY), rates)
    push = jnp.array([1.0, -0.5, 0.8])
    rows = Targets(x, u, jnp.broadcast_to(push, (n, 3)), rates, jnp.ones(n, dtype=bool))
    state = model.init(k_init)
    at, command = jax.tree.map(lambda leaf: leaf[0], (x, u))
    close(model.predict(state, at, command), np.zeros(3), 1e-6, "a fresh state predicts zero")
    fit, fitted_state = eqx.filter_jit(model.fit), state
    for _ in range(fits):
        fitted_state, rms = fit(fitted_state, rows)
    require(shapes(fitted_state) == shapes(state), "a fit keeps the shapes of the state")
    require(jnp.shape(rms) == () and bool(jnp.isfinite(rms)), "the error of a fit is a finite number")
    size = float(jnp.linalg.norm(push))
    close(model.predict(fitted_state, at, command), push, tolerance * size, "a constant acceleration is learned")
    if hasattr(model, "spread"):
        spread = model.spread(fitted_state, at, command)
        require(spread.shape == (3,) and bool((spread >= 0).all()), "the spread is three numbers, none negative")
    nothing = Targets(x, u, rows.a_res, rates, jnp.zeros(n, dtype=bool))
    state_after, _ = fit(fitted_state, nothing)
    finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(eqx.filter(state_after, eqx.is_array)))
    require(finite, "a fit without a valid row stays finite")
