"""The vehicle in a window of flight: the model's vehicle, or a family member that is identified from the window."""

import abc
import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Float, Key

from ..control.belief_flight import belief_from, limit_gain
from ..estimation.command_path import PathEstimate, PathEstimator, PathState
from ..learn.window import Window
from ..physics.command_path import CommandPath
from ..physics.command_path import PathState as QueueState
from ..physics.path_family import Member, PathBelief, PathFamily
from ..physics.state import Command, State
from ..tasks.task import Start

# Ticks between two estimates. Each estimate sets the noise level for the measurements after it, so fewer estimates cost
# accuracy.
PIECE = 5


class AbstractVehicles(eqx.Module):
    """The learners' knowledge about the vehicle."""

    @abc.abstractmethod
    def identify(self, window: Window) -> "Identification | None":
        """Identify the vehicle from a window; return None if it is the model's vehicle.

        Args:
            window: Ticks of flight.
        """

    @abc.abstractmethod
    def apply_path(self, window: Window) -> Window:
        """Return the window with the commands that a model without delay and lag would need as input.

        Args:
            window: Ticks of flight.
        """

    @abc.abstractmethod
    def assign_vehicles(self, starts: Start, identification: "Identification | None", key: Key[Array, ""]) -> Start:
        """Return starts with a vehicle assigned to each; the key is consumed.

        Args:
            starts: Starts of roll-outs, with any leading axes.
            identification: Result of :meth:`identify`.
            key: Random key.
        """


class OwnVehicle(AbstractVehicles):
    """The model's vehicle, with the declared delay."""

    def identify(self, window: Window) -> None:
        """Return None."""

    def apply_path(self, window: Window) -> Window:
        """Return the window unchanged; the delay is a setting of the learner."""
        return window

    def assign_vehicles(self, starts: Start, identification: "Identification | None", key: Key[Array, ""]) -> Start:
        """Return the starts unchanged."""
        return starts


class Identification(NamedTuple):
    """Identification of the vehicle from a window."""

    belief: PathBelief
    path: CommandPath
    """Most likely path, including the thrust gain."""


class IdentifiedVehicle(AbstractVehicles):
    """A vehicle from a family; updates train on samples from the belief about the vehicle."""

    estimator: PathEstimator
    family: PathFamily

    def identify(self, window: Window) -> Identification:
        """Identify the vehicle from the commands and attitudes in a window.

        Args:
            window: Ticks of flight.
        """
        estimate = estimate_path(self.estimator, window)
        belief = belief_from(self.family, estimate)
        path = self.family.path(belief.centre)
        response = dataclasses.replace(path.response, thrust_gain=limit_gain(estimate))
        return Identification(belief, dataclasses.replace(path, response=response))

    def apply_path(self, window: Window) -> Window:
        """Return the window with thrust and rates at the output of the identified path; its first ticks are invalid."""
        path, dt = self.identify(window).path, self.estimator.dt
        first: Command = jax.tree.map(lambda leaf: leaf[0], window.u)

        def tick(s: QueueState, u: Command) -> tuple[QueueState, Command]:
            mean, s = path(s, u, dt)
            return s, mean

        _, acting = lax.scan(tick, path.init(first, dt), window.u)
        settling_ticks = jnp.ceil((path.delay + path.response.settling_time) / dt)
        count = jnp.cumsum(window.valid.astype(window.t.dtype))
        acting = jax.tree.map(lambda new, old: new.astype(old.dtype), acting, window.u)
        return dataclasses.replace(window, u=acting, valid=window.valid & (count > settling_ticks))

    def assign_vehicles(self, starts: Start, identification: "Identification | None", key: Key[Array, ""]) -> Start:
        """Return starts with vehicles drawn from the belief."""
        if identification is None:
            raise ValueError("IdentifiedVehicle.assign_vehicles needs the result of identify, got None")
        belief, shape = identification.belief, starts.t.shape
        inside = random.uniform(key, (*shape, belief.centre.shape[0]), minval=-1.0, maxval=1.0)

        def assign(t: Float[Array, ""], x: State, inside: Float[Array, "4"]) -> Start:
            at = belief.centre + belief.half_width * inside
            return Start(t, x, Member(self.family.path(at), belief))

        for _ in shape:
            assign = jax.vmap(assign)
        return assign(starts.t, starts.x, inside)


def estimate_path(estimator: PathEstimator, window: Window) -> PathEstimate:
    """Estimate the command path from a window of flight.

    Args:
        estimator: Estimator of the path.
        window: Ticks of flight.
    """
    age = jnp.zeros_like(window.t) if window.age is None else window.age

    def tick(s: PathState, row: tuple[Array, State, Command, Array, Array]) -> tuple[PathState, None]:
        t, x, u, valid, age = row
        memory = estimator.issue(estimator.observe(s, t, x, age=age), u)
        return jax.tree.map(lambda new, old: jnp.where(valid, new, old), memory, s), None

    def piece(s: PathState, rows: tuple[Array, State, Command, Array, Array]) -> tuple[PathState, None]:
        return estimator.estimate_path(lax.scan(tick, s, rows)[0]), None

    first = estimator.init(jax.tree.map(lambda leaf: leaf[0], window.x))
    rows = _in_pieces((window.t, window.x, window.u, window.valid, age), PIECE)
    estimate: PathEstimate = lax.scan(piece, first, rows)[0].estimate
    return estimate


def _in_pieces(rows: Any, size: int) -> Any:
    """Return rows with a leading axis of pieces; invalid rows pad the first piece."""
    missing = -len(jax.tree.leaves(rows)[0]) % size

    def divide(leaf: Array) -> Array:
        before = jnp.zeros_like(leaf, shape=(missing, *leaf.shape[1:]))
        return jnp.concatenate([before, leaf]).reshape(-1, size, *leaf.shape[1:])

    return jax.tree.map(divide, rows)
