"""The paper's residual: an ensemble of small networks with a spectral penalty (paper, Sec. III-D)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import lax, random
from jaxtyping import Array, Float, Key

from ...physics.state import STANDARD_GRAVITY, Command, State
from ...tasks.observation import POSITION_SCALE, VELOCITY_SCALE
from .targets import Targets


class EnsembleResidual(eqx.Module):
    """Mean prediction of ReLU networks (19-128-128-3) with the inputs x and u, in the world frame [m/s^2].

    ``offset`` and ``scale`` bring the 19 inputs to order one. Positions are relative to the task's origin, and thrust
    is mass-normalised. Offset and scale are the same in fitting, simulation and flight, and are never trained.
    """

    layers: tuple[tuple[eqx.nn.Linear, ...], ...]
    """Layers of each member, members x layers."""
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
        """Return fresh networks that differ in their seeds; their last layers are zero, so they predict zero."""
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
        """Return the mean prediction of the members [m/s^2]."""
        return jnp.mean(self.members(x, u), axis=0)

    def members(self, x: State, u: Command) -> Float[Array, "members 3"]:
        """Return each member's prediction [m/s^2]; the members disagree in regions without data."""
        features = (jnp.concatenate([x.vector(), u.vector()]) - self.offset) / self.scale
        return jnp.stack([_forward(layers, features) for layers in self.layers])


class EnsembleState(eqx.Module):
    """An ensemble, the state of its optimiser, and one vector per weight matrix for the power iteration."""

    residual: EnsembleResidual
    optimiser: optax.OptState
    vectors: tuple[tuple[Float[Array, " _"], ...], ...]

    @classmethod
    def of(cls, residual: EnsembleResidual, optimiser: optax.GradientTransformation) -> "EnsembleState":
        """Return the state before the first fit."""
        vectors = jax.tree.map(
            lambda l: jnp.ones(l.weight.shape[1], dtype=l.weight.dtype) / l.weight.shape[1] ** 0.5,
            residual.layers,
            is_leaf=lambda l: isinstance(l, eqx.nn.Linear),
        )
        return cls(residual, optimiser.init(residual.layers), vectors)


class EnsembleModel(eqx.Module):
    """The ensemble as a :class:`retrim.learn.ResidualModel`, fitted by Adam; its moments carry over to the next fit."""

    origin: Float[Array, "3"]
    """Task origin in the world frame [m]; positions are taken relative to it."""
    omega_max: Float[Array, "3"]
    """Largest body rates [rad/s]; rates are divided by them."""
    learning_rate: Float[Array, ""]
    spectral_weight: Float[Array, ""]
    """Weight of the spectral penalty."""
    steps: int = eqx.field(static=True, default=100)
    """Optimiser steps per fit."""
    hidden: tuple[int, ...] = eqx.field(static=True, default=(128, 128))
    """Hidden layers of each member."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the number of steps is smaller than one."""
        if self.steps < 1:
            raise ValueError(f"EnsembleModel.steps = {self.steps} must be at least 1")

    def init(self, key: Key[Array, ""]) -> EnsembleState:
        """Return fresh networks that predict zero; the key is consumed."""
        fresh = EnsembleResidual.of(self.origin, self.omega_max, key=key, hidden=self.hidden)
        return EnsembleState.of(fresh, self._optimiser())

    def fit(self, state: EnsembleState, rows: Targets) -> tuple[EnsembleState, Float[Array, ""]]:
        """Fit, starting from the previous fit; also return the error before the last step [m/s^2]."""
        members, errors = fit_ensemble(
            state, rows, optimiser=self._optimiser(), steps=self.steps, spectral_weight=self.spectral_weight
        )
        return members, jnp.sqrt(errors[-1])

    def predict(self, state: EnsembleState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the mean of the members [m/s^2]."""
        return state.residual(x, u)

    def spread(self, state: EnsembleState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the standard deviation of the members [m/s^2]."""
        return jnp.std(state.residual.members(x, u), axis=0)

    def _optimiser(self) -> optax.GradientTransformation:
        return optax.adam(self.learning_rate)


def fit_ensemble(
    state: EnsembleState,
    rows: Targets,
    *,
    optimiser: optax.GradientTransformation,
    steps: int,
    spectral_weight: float | Float[Array, ""],
) -> tuple[EnsembleState, Float[Array, " steps"]]:
    """Minimise, for each member, mean |a_res - f|^2 + w sum_l sigma_max(W_l)^2 on the full batch.

    The spectral norm comes from one power-iteration step per optimiser step, and its vector is kept as state. The
    gradient of sigma^2 is 2 sigma u v^T.

    Args:
        state: Networks, optimiser state and power-iteration vectors to start from.
        rows: Data of the fit.
        optimiser: The optimiser that created ``state.optimiser``.
        steps: Number of optimiser steps.
        spectral_weight: Weight w of the spectral penalty.

    Returns:
        The new state, and the squared data error (mean over members) before each step [m^2/s^4].
    """
    features = jax.vmap(lambda x, u: jnp.concatenate([x.vector(), u.vector()]))(rows.x, rows.u)
    features = (features - state.residual.offset[None]) / state.residual.scale[None]
    weight = rows.valid.astype(features.dtype)
    weight = weight / jnp.maximum(jnp.sum(weight), 1.0)

    def loss(layers: Any, vectors: Any) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Any]]:
        data, spectral, next_vectors = jnp.zeros_like(features[0, 0]), jnp.zeros_like(features[0, 0]), []
        for member, starting in zip(layers, vectors, strict=True):
            predictions = jax.vmap(lambda f, member=member: _forward(member, f))(features)
            data += jnp.sum(weight * jnp.sum((rows.a_res - predictions) ** 2, axis=1))
            norms = [_spectral(layer.weight, v) for layer, v in zip(member, starting, strict=True)]
            spectral += sum(square for square, _ in norms)
            next_vectors.append(tuple(v for _, v in norms))
        return data + spectral_weight * spectral, (data, tuple(next_vectors))

    def step(carry: Any, _: None) -> Any:
        layers, memory, vectors = carry
        gradient, (data, vectors) = jax.grad(loss, has_aux=True)(layers, vectors)
        update, memory = optimiser.update(gradient, memory, layers)
        return (optax.apply_updates(layers, update), memory, vectors), data

    start = (state.residual.layers, state.optimiser, state.vectors)
    (layers, memory, vectors), errors = lax.scan(step, start, length=steps)
    residual = eqx.tree_at(lambda r: r.layers, state.residual, layers)
    return EnsembleState(residual, memory, vectors), errors / len(layers)


def _forward(layers: tuple[eqx.nn.Linear, ...], h: Float[Array, " n"]) -> Float[Array, "3"]:
    for layer in layers[:-1]:
        h = jax.nn.relu(layer(h))
    return layers[-1](h)


def _spectral(W: Float[Array, "m n"], v: Float[Array, " n"]) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    """Return sigma_max(W)^2, estimated by one power step from ``v``, and the next ``v``; zero for a zero matrix."""
    tiny = jnp.asarray(1e-20, dtype=W.dtype)
    u = lax.stop_gradient(W @ v)
    u = u / jnp.sqrt(jnp.sum(u * u) + tiny)
    v_next = lax.stop_gradient(W.T @ u)
    size = jnp.sqrt(jnp.sum(v_next * v_next))
    v_next = jnp.where(size > 1e-10, v_next / jnp.maximum(size, 1e-10), v)
    return jnp.sum(u * (W @ v_next)) ** 2, v_next
