"""Policies: networks from an observation to a command, centred at hover and bounded."""

import abc
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Float, Key

from ..physics.state import Command
from ..physics.vehicle import Vehicle

Perturbations = tuple[Float[Array, "... _"], ...]
"""One vector per layer (with leading rows in :mod:`retrim.learn`), added to the pre-activation."""
Layers = tuple[eqx.nn.Linear, ...]
"""The layers of a policy, or a gradient with respect to them."""
Inputs = tuple[Float[Array, "... _"], ...]
"""Inputs of each layer."""


class AbstractPolicy(eqx.Module):
    """A network whose output is mapped to a command; the parameters are trained, and the limits are constant.

    u = u_min + (u_max - u_min) sigmoid(y + y_0), where y is the network's output and y_0 makes y = 0 the hover
    command. A hard limit would have a zero gradient once it is reached; the sigmoid always has a gradient.
    """

    if TYPE_CHECKING:  # a type checker would treat an abstract variable as a dataclass field

        @property
        def u_hover(self) -> Command:
            """Command for a zero output."""

        @property
        def u_min(self) -> Command:
            """Lower limit of commands."""

        @property
        def u_max(self) -> Command:
            """Upper limit of commands."""
    else:
        u_hover: eqx.AbstractVar[Command]
        u_min: eqx.AbstractVar[Command]
        u_max: eqx.AbstractVar[Command]

    @property
    @abc.abstractmethod
    def params(self) -> Any:
        """Parameters that an optimiser updates: a pytree of arrays."""

    @abc.abstractmethod
    def with_params(self, params: Any) -> "AbstractPolicy":
        """Return the same policy with different parameters."""

    @abc.abstractmethod
    def output(self, observation: Float[Array, " o"]) -> Float[Array, "4"]:
        """Return the network's output y for one observation."""

    @abc.abstractmethod
    def shifted(self, by: Float[Array, "4"]) -> "AbstractPolicy":
        """Return the policy with ``by`` added to its output for every observation."""

    def merged(self) -> "AbstractPolicy":
        """Return the policy itself; a low-rank policy merges its delta here."""
        return self

    def linear_layers(self) -> Layers:
        """Return a perceptron's layers, for low-rank adaptation and export; other networks return an empty tuple."""
        return ()

    def __call__(self, observation: Float[Array, " o"]) -> Command:
        """Return the command for one observation."""
        return self.limit(self.output(observation))

    def limit(self, y: Float[Array, "4"]) -> Command:
        """Map the network's output to a command within the limits; zero maps to hover."""
        low, high, hover = (lax.stop_gradient(u.vector()) for u in (self.u_min, self.u_max, self.u_hover))
        y_0 = jnp.log((hover - low) / (high - hover))
        return Command.of(low + (high - low) * jax.nn.sigmoid(y + y_0))


class Policy(AbstractPolicy):
    """A ReLU perceptron, whose ``layers`` are trained."""

    layers: tuple[eqx.nn.Linear, ...]
    u_hover: Command
    u_min: Command
    u_max: Command

    @classmethod
    def of(
        cls, observation_size: int, vehicle: Vehicle, *, key: Key[Array, ""], hidden: tuple[int, ...] = (512, 512)
    ) -> "Policy":
        """Return a fresh network that commands hover.

        The kernels are N(0, 0.01 / mean of fan-in and fan-out), and the biases are zero.

        Args:
            observation_size: Length of the observation.
            vehicle: Vehicle that defines the command limits.
            key: Random key, consumed.
            hidden: Widths of the hidden layers.
        """
        sizes = (observation_size, *hidden, 4)
        layers = []
        for fan_in, fan_out, k in zip(sizes[:-1], sizes[1:], random.split(key, len(sizes) - 1), strict=True):
            std = (0.01 * 2.0 / (fan_in + fan_out)) ** 0.5
            blank = eqx.nn.Linear(fan_in, fan_out, key=k)
            layers.append(
                eqx.tree_at(
                    lambda l: (l.weight, l.bias),
                    blank,
                    (std * random.normal(k, (fan_out, fan_in)), jnp.zeros(fan_out)),
                )
            )
        return cls(tuple(layers), *command_bounds(vehicle))

    @property
    def params(self) -> Layers:
        """Parameters that an optimiser updates."""
        return self.layers

    def with_params(self, layers: Layers) -> "Policy":
        """Return the same policy with different layers."""
        return Policy(layers, self.u_hover, self.u_min, self.u_max)

    def linear_layers(self) -> Layers:
        """Return the layers."""
        return self.layers

    def shifted(self, by: Float[Array, "4"]) -> "Policy":
        """Return the policy with ``by`` added to its output for every observation."""
        *layers, last = self.layers
        return self.with_params((*layers, eqx.tree_at(lambda l: l.bias, last, replace_fn=lambda bias: bias + by)))

    def output(self, observation: Float[Array, " o"]) -> Float[Array, "4"]:
        """Return the network's output y for one observation."""
        h = observation
        for layer in self.layers[:-1]:
            h = jax.nn.relu(layer(h))
        return self.layers[-1](h)

    def perturb(self, observation: Float[Array, " o"], perturbations: Perturbations) -> tuple[Command, Inputs]:
        """Return the command with ``perturbations[l]`` added to the output of layer l.

        Also return the input of each layer; with the cotangents of the perturbations, these give every weight gradient.
        """
        h, inputs = observation, []
        for i, (layer, perturbation) in enumerate(zip(self.layers, perturbations, strict=True)):
            inputs.append(h)
            y = layer(h) + perturbation
            h = jax.nn.relu(y) if i < len(self.layers) - 1 else y
        return self.limit(h), tuple(inputs)


def command_bounds(vehicle: Vehicle) -> tuple[Command, Command, Command]:
    """Return the hover command and the lower and upper limits of a vehicle's commands."""
    bounds = (Command.hover(), vehicle.command_min, vehicle.command_max)
    # Strong types, as in a loaded policy, so that programs for one are not compiled again for the other.
    strong: tuple[Command, Command, Command] = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=leaf.dtype), bounds)
    return strong
