"""A map of the acceleration over position, learned over minutes, in addition to a residual model with a short memory.

Forces near surfaces and below other vehicles depend on the position and repeat at every pass. A model with a memory of
seconds learns them too late, since the vehicle is then elsewhere. The map is a Bayesian regression on Gaussian bumps,
whose centres are placed along the path of the vehicle. Far from the path, it predicts zero.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Bool, Float, Int, Key

from ...physics.state import Command, State, where
from .linear_systems import solve_positive
from .model import ResidualModel
from .rates import RateFit
from .targets import Targets

CENTRES = 192  # number of bumps; the least recently visited one is replaced
SPACING = 0.7  # distance between centres along the path [lengths]
WANDER = 0.3  # [m/s^2], random walk of the part that does not depend on position, in one second
EVIDENCE = 20.0  # [m^2/s^4], sum over rows of the squared prediction, after which the evidence for the map is 1/e
RECALL_EVIDENCE = 2.0  # [m^2/s^4], evidence for the map of an earlier flight
RECALL_INFORMATION = 0.1  # share of the information of an earlier flight that remains
DOUBT = 1.0  # [m^2/s^4], prior evidence against the map

Centres = tuple[Float[Array, "m 3"], Int[Array, " m"], Bool[Array, " m"]]
"""Centres, number of their last visit, and whether they are new."""


class PlaceMap(eqx.Module):
    """Information about the weights of the bumps and of a constant (last), in units of their prior."""

    centres: Float[Array, "m 3"]
    """Centres of the bumps, world [m]."""
    visited: Int[Array, " m"]
    """Number of the last fit with a row near this centre; -1 for an unused centre."""
    precision: Float[Array, "n n"]
    """Precision of the weights, n = m + 1, including the prior."""
    moment: Float[Array, "n 3"]
    """Precision times mean."""
    weights: Float[Array, "n 3"]
    """Mean of the weights [m/s^2]."""


class PlaceState(eqx.Module):
    """State of the map and of the model with a short memory."""

    first: Any
    map: PlaceMap
    agreement: Float[Array, ""]
    """Sum of prediction times remainder over recent rows that the map had not been fitted to [m^2/s^4]."""
    prediction: Float[Array, ""]
    """Sum of the squared prediction over the same rows [m^2/s^4]."""
    fits: Int[Array, ""]
    """Number of fits so far. The first one uses its whole window; each later one uses only the new rows."""

    @property
    def share(self) -> Float[Array, ""]:
        """Share of the map's prediction that is used, between 0 and 1."""
        return jnp.clip(self.agreement / (self.prediction + DOUBT), 0.0, 1.0)


class PlaceModel(eqx.Module):
    """A residual model with a map over position, as a :class:`retrim.learn.ResidualModel`.

    The map is fitted to the remainder of the first model, excluding a part that is the same everywhere and that wanders
    with time, such as a steady push. Before each fit, the map predicts the new rows, and the remainder is regressed on
    this prediction. The coefficient, between 0 and 1, is the share of the map that is used. A map of another place, or
    of a surface that was removed, therefore loses its influence within a few passes.
    """

    first: ResidualModel
    """Model of the part that depends on velocity, attitude and command, with a memory of seconds."""
    length: Float[Array, ""]
    """Standard deviation of a bump [m]."""
    prior: Float[Array, ""]
    """Prior standard deviation of a bump's weight [m/s^2]."""
    noise: Float[Array, ""]
    """Standard deviation of one row of targets [m/s^2]."""
    memory: Float[Array, ""]
    """Age at which the weight of a row is 1/e of the newest row's weight [s]."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    every: float = eqx.field(static=True)
    """Time between fits [s]."""

    @classmethod
    def of(
        cls,
        first: ResidualModel,
        dt: float,
        *,
        every: float,
        length: float = 0.12,
        prior: float = 2.0,
        noise: float = 0.5,
        memory: float = 300.0,
    ) -> "PlaceModel":
        """Return the model with default priors.

        Args:
            first: Model with a short memory.
            dt: Control tick [s].
            every: Time between fits [s].
            length: Standard deviation of a bump [m].
            prior: Prior standard deviation of a bump's weight [m/s^2].
            noise: Standard deviation of one row of targets [m/s^2].
            memory: Time constant of forgetting [s].
        """
        return cls(first, jnp.array(length), jnp.array(prior), jnp.array(noise), jnp.array(memory), dt, every)

    def init(self, key: Key[Array, ""]) -> PlaceState:
        """Return the state without information, which predicts zero; the key is consumed by the first model."""
        eye = jnp.eye(CENTRES + 1, dtype=self.prior.dtype)
        nothing = jnp.zeros((CENTRES + 1, 3), dtype=eye.dtype)
        no_visits = jnp.full(CENTRES, -1, dtype=jnp.int32)
        empty = PlaceMap(nothing[1:], no_visits, eye, nothing, nothing)
        zero = jnp.zeros((), dtype=eye.dtype)
        return PlaceState(self.first.init(key), empty, zero, zero, jnp.zeros((), dtype=jnp.int32))

    def fit(self, state: PlaceState, rows: Targets) -> tuple[PlaceState, Float[Array, ""]]:
        """Fit the first model to the remainder of the map, then the map to the remainder of the first model."""
        p = rows.x.p + 0.5 * self.dt * rows.x.v  # mean position over the tick
        bumps = self._bumps(state.map, p)
        forecast = bumps @ state.map.weights[:-1]
        rest = dataclasses.replace(rows, a_res=rows.a_res - state.share * forecast)
        first, _ = self.first.fit(state.first, rest)
        age = jnp.arange(rows.valid.shape[0] - 1, -1, -1)
        new = rows.valid & ((age < round(self.every / self.dt)) | (state.fits == 0))
        remainder = rows.a_res - jax.vmap(lambda x: self._predict_drag(first, x))(rows.x)
        agreement, prediction = self._update_evidence(state, forecast, remainder - state.map.weights[-1:], new)
        after = self._learn(state.map, p, remainder, new, state.fits)
        new_state = PlaceState(first, after, agreement, prediction, state.fits + 1)
        error = rows.a_res - jax.vmap(lambda x, u: self.predict(new_state, x, u))(rows.x, rows.u)
        valid = rows.valid.astype(error.dtype)
        mean_square = jnp.sum(valid * jnp.sum(error**2, axis=1)) / jnp.maximum(jnp.sum(valid), 1.0)
        return where(jnp.any(rows.valid), new_state, state), jnp.sqrt(mean_square)

    def predict(self, state: PlaceState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the sum of the first model's prediction and the map, world [m/s^2]."""
        return self.first.predict(state.first, x, u) + self.at_place(state, x.p)

    def at_place(self, state: PlaceState, p: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the acceleration that the map predicts at a position, world [m/s^2].

        Args:
            state: State of the model.
            p: Position, world [m].
        """
        return state.share * (self._bumps(state.map, p[None])[0] @ state.map.weights[:-1])

    def recall(self, state: PlaceState) -> PlaceState:
        """Return the state for the start of a flight, given the state at the end of an earlier one.

        The map remains, with little evidence for it and little weight, since the place may have changed: a few rows of
        flight decide whether it is used, and one pass replaces it. The model with the short memory starts anew.

        Args:
            state: State at the end of the earlier flight.
        """
        evidence = jnp.where(state.share > 0.5, RECALL_EVIDENCE, 0.0).astype(state.agreement.dtype)
        before, eye = state.map, jnp.eye(CENTRES + 1, dtype=state.agreement.dtype)
        precision, moment = (
            RECALL_INFORMATION * before.precision + (1.0 - RECALL_INFORMATION) * eye,
            RECALL_INFORMATION * before.moment,
        )
        weak_map = dataclasses.replace(
            before, precision=precision, moment=moment, weights=self._solve(precision, moment)
        )
        return dataclasses.replace(
            state, first=self.first.init(random.key(0)), map=weak_map, agreement=evidence, prediction=evidence
        )

    def strength(self, state: PlaceState) -> Float[Array, ""]:
        """Return the largest weight of a bump [m/s^2]; it is not finite if the map is unusable.

        Args:
            state: State of the model.
        """
        return jnp.max(jnp.abs(state.map.weights))

    def turning(self, state: PlaceState) -> RateFit | None:
        """Return the bias and lag of the body rates, if the first model identifies them."""
        turning = getattr(self.first, "turning", None)
        return None if turning is None else turning(state.first)

    def _bumps(self, place_map: PlaceMap, p: Float[Array, "rows 3"]) -> Float[Array, "rows m"]:
        square = jnp.sum((p[:, None] - place_map.centres[None]) ** 2, axis=2)
        return jnp.exp(-0.5 * square / self.length**2) * (place_map.visited >= 0)[None].astype(p.dtype)

    def _predict_drag(self, first: Any, x: State) -> Float[Array, "3"]:
        """Return the part of the first model that depends on velocity and attitude.

        Its part that depends on the command belongs to the map: while a local force acts, the command compensates it,
        so a short window does not distinguish the force from a different thrust gain.
        """
        hover = Command.hover(x.p.dtype)
        return self.first.predict(first, x, hover) - self.first.predict(first, State.at(x.p), hover)

    def _update_evidence(
        self,
        state: PlaceState,
        forecast: Float[Array, "rows 3"],
        remainder: Float[Array, "rows 3"],
        new: Bool[Array, " rows"],
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the evidence for the map. Evidence fades with further predictions, not with time."""
        counts = new.astype(forecast.dtype)
        square = jnp.sum(counts * jnp.sum(forecast**2, axis=1))
        product = jnp.sum(counts * jnp.sum(forecast * remainder, axis=1))
        remains = jnp.exp(-square / EVIDENCE)
        return remains * state.agreement + product, remains * state.prediction + square

    def _learn(
        self,
        before: PlaceMap,
        p: Float[Array, "rows 3"],
        target: Float[Array, "rows 3"],
        new: Bool[Array, " rows"],
        fits: Int[Array, ""],
    ) -> PlaceMap:
        """Return the map after the new rows: place centres, forget, and solve for the weights."""
        place_map = self._place_centres(before, p, new, fits)
        remains, eye = jnp.exp(-self.every / self.memory), jnp.eye(CENTRES + 1, dtype=p.dtype)
        precision = remains * place_map.precision + (1.0 - remains) * eye
        moment = remains * place_map.moment
        # The constant wanders: add variance to it.
        column, variance = precision[:, -1], (WANDER / self.prior) ** 2 * self.every
        gain = column / (1.0 / variance + column[-1])
        precision, moment = precision - jnp.outer(gain, column), moment - jnp.outer(gain, moment[-1])
        bumps = jnp.concatenate([self._bumps(place_map, p), jnp.ones_like(p[:, :1])], axis=1) * self.prior
        weight = new.astype(p.dtype)[:, None] / self.noise**2
        precision = precision + bumps.T @ (weight * bumps)
        moment = moment + bumps.T @ (weight * target)
        return PlaceMap(place_map.centres, place_map.visited, precision, moment, self._solve(precision, moment))

    def _solve(self, precision: Float[Array, "n n"], moment: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        (weights,) = solve_positive(precision, moment)
        return self.prior * weights

    def _place_centres(
        self, before: PlaceMap, p: Float[Array, "rows 3"], new: Bool[Array, " rows"], fits: Int[Array, ""]
    ) -> PlaceMap:
        """Return the map with a centre within the spacing of each new row; a new centre has no information."""
        centres, visited = before.centres, before.visited

        def visit(carry: Centres, row: tuple[Float[Array, "3"], Bool[Array, ""]]) -> tuple[Centres, None]:
            centres, visited, fresh = carry
            position, counts = row
            square = jnp.sum((centres - position[None]) ** 2, axis=1)
            near = (square < (SPACING * self.length) ** 2) & (visited >= 0)
            oldest = jnp.arange(CENTRES) == jnp.argmin(visited)
            is_replaced = oldest & counts & ~jnp.any(near)
            centres = jnp.where(is_replaced[:, None], position[None], centres)
            visited = jnp.where((near & counts) | is_replaced, fits, visited)
            return (centres, visited, fresh | is_replaced), None

        none = jnp.zeros(CENTRES, dtype=bool)
        (centres, visited, fresh), _ = lax.scan(visit, (centres, visited, none), (p, new))
        fresh, eye = jnp.append(fresh, False), jnp.eye(CENTRES + 1, dtype=p.dtype)
        return PlaceMap(
            centres,
            visited,
            jnp.where(fresh[:, None] | fresh[None], eye, before.precision),
            jnp.where(fresh[:, None], 0.0, before.moment),
            jnp.where(fresh[:, None], 0.0, before.weights),
        )
