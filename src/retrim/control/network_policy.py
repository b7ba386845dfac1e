"""A policy around any network that maps an observation to four numbers."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..physics.state import Command
from ..physics.vehicle import Vehicle
from .policy import AbstractPolicy, command_bounds


class NetworkPolicy(AbstractPolicy):
    """A policy whose network is an Equinox module; plain differentiation trains its floating-point arrays."""

    leaves: tuple[Array, ...]
    """Arrays of the network, in the order of its pytree."""
    u_hover: Command
    u_min: Command
    u_max: Command
    shift: Float[Array, "4"]
    """Addition to the output of the network; it is not trained."""
    structure: Any = eqx.field(static=True)
    """Structure of the pytree, and the network without its arrays."""

    @classmethod
    def create(cls, network: eqx.Module, vehicle: Vehicle) -> "NetworkPolicy":
        """Return a policy with the given network.

        Args:
            network: Module that is called with one observation and returns four numbers, for thrust and body rates.
                Zeros map to the hover command, so a network whose initial outputs are small begins near hover.
            vehicle: Vehicle that defines the command limits.
        """
        arrays, rest = eqx.partition(network, eqx.is_array)
        leaves, tree = jax.tree.flatten(arrays)
        bounds = command_bounds(vehicle)
        return cls(tuple(leaves), *bounds, jnp.zeros_like(bounds[0].vector()), (tree, rest))

    @property
    def params(self) -> tuple[Array, ...]:
        """Floating-point arrays of the network."""
        return tuple(leaf for leaf in self.leaves if eqx.is_inexact_array(leaf))

    def with_params(self, params: tuple[Array, ...]) -> "NetworkPolicy":
        """Return the same policy with different parameters."""
        new = iter(params)
        leaves = tuple(next(new) if eqx.is_inexact_array(leaf) else leaf for leaf in self.leaves)
        return dataclasses.replace(self, leaves=leaves)

    def output(self, observation: Float[Array, " o"]) -> Float[Array, "4"]:
        """Return the network's output y for one observation."""
        tree, rest = self.structure
        y: Array = eqx.combine(jax.tree.unflatten(tree, self.leaves), rest)(observation)
        return y + lax.stop_gradient(self.shift)

    def shifted(self, by: Float[Array, "4"]) -> "NetworkPolicy":
        """Return the policy with ``by`` added to its output for every observation."""
        return dataclasses.replace(self, shift=self.shift + by)
