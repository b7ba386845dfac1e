"""The policy network: observation -> command, centred at hover and bounded."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Float, Key

from ..physics.state import Command
from ..physics.vehicle import Vehicle

Perturbations = tuple[Float[Array, "... _"], ...]
"""One vector per layer (in :mod:`retrim.learn` with rows in front), added to the pre-activation."""
Layers = tuple[eqx.nn.Linear, ...]
"""The layers of a policy, or a gradient with respect to them."""
Inputs = tuple[Float[Array, "... _"], ...]
"""Inputs of each layer."""


class Policy(eqx.Module):
    """A ReLU network with a smooth, bounded output. ``layers`` are trained; the commands are constant.

    u = u_min + (u_max - u_min) sigmoid(y + y_0), where y is the network's output and y_0 makes y = 0 the hover
    command. A hard limit would not have a gradient once it is reached; the sigmoid always has one.
    """

    layers: tuple[eqx.nn.Linear, ...]
    u_hover: Command
    u_min: Command
    u_max: Command

    @classmethod
    def of(
        cls, observation_size: int, vehicle: Vehicle, *, key: Key[Array, ""], hidden: tuple[int, ...] = (512, 512)
    ) -> "Policy":
        """Return a fresh network: kernels N(0, 0.01 / mean of fan-in and fan-out), biases zero; it commands hover.

        Args:
            observation_size: Length of the observation.
            vehicle: Vehicle with the limits of the commands.
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
        bounds = (Command.hover(), vehicle.command_min, vehicle.command_max)
        # Strong types, as in a loaded policy, so that programs for one are not compiled again for the other.
        bounds = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=leaf.dtype), bounds)
        return cls(tuple(layers), *bounds)

    @property
    def params(self) -> Layers:
        """Return the parameters that an optimiser updates."""
        return self.layers

    def with_params(self, layers: Layers) -> "Policy":
        """Return the same policy with other layers."""
        return Policy(layers, self.u_hover, self.u_min, self.u_max)

    def merged(self) -> "Policy":
        """Return itself; a low-rank policy merges its delta here."""
        return self

    def shifted(self, by: Float[Array, "4"]) -> "Policy":
        """Return the policy whose output is ``by`` larger, for every observation."""
        *layers, last = self.layers
        return self.with_params((*layers, eqx.tree_at(lambda l: l.bias, last, replace_fn=lambda bias: bias + by)))

    def __call__(self, observation: Float[Array, " o"]) -> Command:
        """Return the command for one observation."""
        return self.bounded(self.output(observation))

    def output(self, observation: Float[Array, " o"]) -> Float[Array, "4"]:
        """Return the network's output y for one observation."""
        h = observation
        for layer in self.layers[:-1]:
            h = jax.nn.relu(layer(h))
        return self.layers[-1](h)

    def perturbed(self, observation: Float[Array, " o"], perturbations: Perturbations) -> tuple[Command, Inputs]:
        """Return the command with ``perturbations[l]`` added to the output of layer l, without gradients to weights.

        Also return the input of each layer; with the cotangents of the perturbations they give every weight gradient.
        """
        h, inputs = observation, []
        for i, (layer, perturbation) in enumerate(zip(self.layers, perturbations, strict=True)):
            inputs.append(h)
            y = lax.stop_gradient(layer)(h) + perturbation
            h = jax.nn.relu(y) if i < len(self.layers) - 1 else y
        return self.bounded(h), tuple(inputs)

    def bounded(self, y: Float[Array, "4"]) -> Command:
        """Map the network's output to a command within the limits; zero maps to hover."""
        low, high, hover = (lax.stop_gradient(u.vector()) for u in (self.u_min, self.u_max, self.u_hover))
        y_0 = jnp.log((hover - low) / (high - hover))
        return Command.of(low + (high - low) * jax.nn.sigmoid(y + y_0))
