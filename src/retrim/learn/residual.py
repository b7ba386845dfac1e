"""Residual dynamics: what the nominal model missed over the last seconds of flight (paper, Sec. III-D)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import lax, random
from jaxtyping import Array, Bool, Float, Key

from ..physics.dynamics import AbstractDynamics
from ..physics.state import STANDARD_GRAVITY, Command, State
from ..tasks.observation import POSITION_SCALE, VELOCITY_SCALE


class Window(eqx.Module):
    """The last ``n`` ticks of a flight, oldest first. While it fills, ``valid`` is false in front."""

    t: Float[Array, " n"]
    """Time of each tick since take-off [s]."""
    x: State
    """State at each tick (leading axis n)."""
    u: Command
    """Command *issued* at each tick."""
    valid: Bool[Array, " n"]


class ZeroResidual(eqx.Module):
    """Nothing missed; for pretraining."""

    def __call__(self, x: State, u: Command) -> Float[Array, "3"]:
        """Zero."""
        return jnp.zeros_like(x.p)


class EnsembleResidual(eqx.Module):
    """Mean of ``members`` ReLU networks 19-128-128-3 on [x, u] [m/s^2], world frame.

    ``offset`` and ``scale`` bring the 19 inputs to order one: positions relative to the task's origin, thrust
    mass-normalised. They are the same in fitting, simulation and flight, and are never trained.
    """

    layers: tuple[tuple[eqx.nn.Linear, ...], ...]
    """members x layers"""
    offset: Float[Array, "19"]
    scale: Float[Array, "19"]

    @classmethod
    def of(
        cls,
        origin: Float[Array, "3"],
        omega_max: Float[Array, "3"],
        *,
        key: Key[Array, ""],
        members: int = 3,
        hidden: tuple[int, ...] = (128, 128),
    ) -> "EnsembleResidual":
        """Fresh networks that differ in their seeds; the last layer is zero, so that they predict nothing yet."""
        sizes = (19, *hidden, 3)

        def member(key: Key[Array, ""]) -> tuple[eqx.nn.Linear, ...]:
            layers = []
            for fan_in, fan_out, k in zip(sizes[:-1], sizes[1:], random.split(key, len(sizes) - 1), strict=True):
                std = 0.0 if fan_out == 3 else (2.0 / (fan_in + fan_out)) ** 0.5
                weights = std * random.normal(k, (fan_out, fan_in)), jnp.zeros(fan_out)
                blank = eqx.nn.Linear(fan_in, fan_out, key=k)
                layers.append(eqx.tree_at(lambda l: (l.weight, l.bias), blank, weights))
            return tuple(layers)

        nothing = jnp.zeros(12)
        return cls(
            tuple(member(k) for k in random.split(key, members)),
            offset=jnp.concatenate([origin, nothing, jnp.array([STANDARD_GRAVITY, 0.0, 0.0, 0.0])]),
            scale=jnp.concatenate(
                [
                    jnp.full(3, POSITION_SCALE),
                    jnp.ones(9),
                    jnp.full(3, VELOCITY_SCALE),
                    jnp.array([STANDARD_GRAVITY]),
                    omega_max,
                ]
            ),
        )

    def __call__(self, x: State, u: Command) -> Float[Array, "3"]:
        """Mean prediction of the members."""
        return jnp.mean(self.members(x, u), axis=0)

    def members(self, x: State, u: Command) -> Float[Array, "members 3"]:
        """Each member's prediction; their spread shows where there were no data."""
        features = (jnp.concatenate([x.vector(), u.vector()]) - self.offset) / self.scale
        return jnp.stack([_forward(layers, features) for layers in self.layers])


class ResidualState(eqx.Module):
    """A residual, its optimiser's state, and one vector per weight matrix for the power iteration."""

    residual: EnsembleResidual
    optimiser: optax.OptState
    vectors: tuple[tuple[Float[Array, " _"], ...], ...]

    @classmethod
    def of(cls, residual: EnsembleResidual, optimiser: optax.GradientTransformation) -> "ResidualState":
        """Before the first fit."""
        vectors = jax.tree.map(
            lambda l: jnp.ones(l.weight.shape[1], dtype=l.weight.dtype) / l.weight.shape[1] ** 0.5,
            residual.layers,
            is_leaf=lambda l: isinstance(l, eqx.nn.Linear),
        )
        return cls(residual, optimiser.init(residual.layers), vectors)


class Targets(eqx.Module):
    """Rows for the fit: inputs, the acceleration that was missed, and which rows count."""

    x: State
    u: Command
    """Command *acting* during the tick."""
    a_res: Float[Array, "n 3"]
    """World frame [m/s^2]."""
    valid: Bool[Array, " n"]


def residual_targets(window: Window, nominal: AbstractDynamics[Any], *, delay: int = 0) -> Targets:
    """a_res = a_gt - a_hat of each tick.

    a_gt is the forward difference of velocity over the tick, a_hat that of the nominal model from the same state, both
    under the command that was acting: the one issued ``delay`` ticks before. n ticks give n - 1 - delay rows.
    """
    n = window.valid.shape[0]
    rows = n - 1 - delay
    if rows < 1:
        raise ValueError(f"a window of {n} ticks is too short for a delay of {delay} ticks")
    x = jax.tree.map(lambda leaf: leaf[delay : delay + rows], window.x)
    v_next = window.x.v[delay + 1 :]
    u = jax.tree.map(lambda leaf: leaf[:rows], window.u)

    def tick(s: Any, row: tuple[State, Command, Float[Array, "3"]]) -> tuple[Any, Float[Array, "3"]]:
        x, u, v_next = row
        after = nominal.step(nominal.with_state(s, x), u, jnp.zeros_like(x.p))  # what is hidden in s, as lag, goes on
        return after, (v_next - nominal.state(after).v) / nominal.dt

    first = nominal.init(jax.tree.map(lambda leaf: leaf[0], x))
    _, a_res = lax.scan(tick, first, (x, u, v_next))
    return Targets(x, u, a_res, window.valid[:rows])


def fit_residual(
    state: ResidualState,
    rows: Targets,
    *,
    optimiser: optax.GradientTransformation,
    iters: int,
    beta: float | Float[Array, ""],
) -> tuple[ResidualState, Float[Array, " iters"]]:
    """Minimise, for each member, mean |a_res - f|^2 + beta sum_l sigma_max(W_l)^2; full batch, ``iters`` steps.

    The spectral norm comes from one power-iteration step per optimiser step, its vector kept as state; the gradient of
    sigma^2 is 2 sigma u v^T. Also returns the data error, its mean
    over members, before each step.
    """
    features = jax.vmap(lambda x, u: jnp.concatenate([x.vector(), u.vector()]))(rows.x, rows.u)
    features = (features - state.residual.offset[None]) / state.residual.scale[None]
    weight = rows.valid.astype(features.dtype)
    weight = weight / jnp.maximum(jnp.sum(weight), 1.0)

    def loss(layers: Any, vectors: Any) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Any]]:
        data, spectral, moved = jnp.zeros_like(features[0, 0]), jnp.zeros_like(features[0, 0]), []
        for member, starting in zip(layers, vectors, strict=True):
            predicted = jax.vmap(lambda f, member=member: _forward(member, f))(features)
            data += jnp.sum(weight * jnp.sum((rows.a_res - predicted) ** 2, axis=1))
            norms = [_spectral(layer.weight, v) for layer, v in zip(member, starting, strict=True)]
            spectral += sum(squared for squared, _ in norms)
            moved.append(tuple(v for _, v in norms))
        return data + beta * spectral, (data, tuple(moved))

    def step(carry: Any, _: None) -> Any:
        layers, memory, vectors = carry
        gradient, (data, vectors) = jax.grad(loss, has_aux=True)(layers, vectors)
        update, memory = optimiser.update(gradient, memory, layers)
        return (optax.apply_updates(layers, update), memory, vectors), data

    start = (state.residual.layers, state.optimiser, state.vectors)
    (layers, memory, vectors), errors = lax.scan(step, start, length=iters)
    residual = eqx.tree_at(lambda r: r.layers, state.residual, layers)
    return ResidualState(residual, memory, vectors), errors / len(layers)


def _forward(layers: tuple[eqx.nn.Linear, ...], h: Float[Array, " n"]) -> Float[Array, "3"]:
    for layer in layers[:-1]:
        h = jax.nn.relu(layer(h))
    return layers[-1](h)


def _spectral(W: Float[Array, "m n"], v: Float[Array, " n"]) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    """sigma_max(W)^2, estimated by one power step from ``v``, and the next ``v``. A zero matrix has norm zero."""
    tiny = jnp.asarray(1e-20, dtype=W.dtype)
    u = lax.stop_gradient(W @ v)
    u = u / jnp.sqrt(jnp.sum(u * u) + tiny)
    v_next = lax.stop_gradient(W.T @ u)
    size = jnp.sqrt(jnp.sum(v_next * v_next))
    v_next = jnp.where(size > 1e-10, v_next / jnp.maximum(size, 1e-10), v)
    return jnp.sum(u * (W @ v_next)) ** 2, v_next
