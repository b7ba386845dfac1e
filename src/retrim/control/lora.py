"""Low-rank adaptation (Hu et al. 2022; paper, Sec. III-F): a frozen base, and two trained thin factors per layer.

y = (W + scale * B A) x + b. B starts at zero, so a fresh delta does not change the policy. A network of the
paper's size has 12,864 numbers to train instead of 272,900.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Float, Key

from .policy import Layers, Policy

RANKS = (4, 10, 1)
SCALE = 4.0


class LowRankFactors(eqx.Module):
    """Factors of the addition to one weight matrix, ``scale * up @ down``."""

    down: Float[Array, "rank fan_in"]
    """Factor A."""
    up: Float[Array, "fan_out rank"]
    """Factor B."""


class LoraPolicy(eqx.Module):
    """A frozen policy and a trained delta. Train it like a :class:`Policy`, and use :meth:`merged` in flight."""

    base: Policy
    delta: tuple[LowRankFactors, ...]
    scale: Float[Array, ""]
    shift: Float[Array, "4"]
    """Addition to the output of the network; it is not trained."""

    def __check_init__(self) -> None:
        """Raise ``ValueError``, with the shapes, if the delta does not fit the base."""
        if len(self.delta) != len(self.base.layers):
            raise ValueError(f"LoRA: {len(self.delta)} deltas for {len(self.base.layers)} layers")
        for i, (layer, thin) in enumerate(zip(self.base.layers, self.delta, strict=True)):
            shape, product = layer.weight.shape, (thin.up.shape[0], thin.down.shape[1])
            if shape != product or thin.up.shape[1] != thin.down.shape[0]:
                raise ValueError(f"LoRA: layer {i} has weights {shape}, the delta {thin.up.shape} x {thin.down.shape}")

    @classmethod
    def of(
        cls, base: Policy, *, key: Key[Array, ""], ranks: tuple[int, ...] = RANKS, scale: float = SCALE
    ) -> "LoraPolicy":
        """Return a fresh delta with A uniform within 1 / sqrt(fan-in) (Kaiming) and B zero, so the output is unchanged.

        Args:
            base: Policy to adapt.
            key: Random key, consumed.
            ranks: One rank per layer (by default those of the paper, for two hidden layers).
            scale: Factor of the product B A.

        Raises:
            ValueError: There is not one rank per layer, or a rank is not between 1 and the smaller side of its matrix.
        """
        if len(ranks) != len(base.layers):
            raise ValueError(f"LoRA: {len(ranks)} ranks {ranks} for {len(base.layers)} layers")
        thin, dtype = [], base.layers[0].weight.dtype
        for layer, rank, k in zip(base.layers, ranks, random.split(key, len(ranks)), strict=True):
            fan_out, fan_in = layer.weight.shape
            if not 1 <= rank <= min(fan_out, fan_in):
                raise ValueError(f"LoRA: rank {rank} for weights {fan_out} x {fan_in}")
            bound = fan_in**-0.5
            down = random.uniform(k, (rank, fan_in), dtype, minval=-bound, maxval=bound)
            thin.append(LowRankFactors(down, jnp.zeros((fan_out, rank), dtype=dtype)))
        return cls(base, tuple(thin), jnp.array(scale, dtype=dtype), jnp.zeros(4, dtype=dtype))

    @property
    def params(self) -> tuple[LowRankFactors, ...]:
        """Parameters that an optimiser updates."""
        return self.delta

    def with_params(self, delta: tuple[LowRankFactors, ...]) -> "LoraPolicy":
        """Return the same base with a different delta."""
        return LoraPolicy(self.base, delta, self.scale, self.shift)

    def shifted(self, by: Float[Array, "4"]) -> "LoraPolicy":
        """Return the policy with ``by`` added to its output for every observation; base and delta are unchanged."""
        return LoraPolicy(self.base, self.delta, self.scale, self.shift + by)

    def merged(self) -> Policy:
        """Return a plain policy with the delta merged into its weights; gradients do not flow to the base."""
        base, scale, shift = lax.stop_gradient((self.base, self.scale, self.shift))
        layers: Layers = tuple(
            eqx.tree_at(lambda l: l.weight, layer, layer.weight + scale * thin.up @ thin.down)
            for layer, thin in zip(base.layers, self.delta, strict=True)
        )
        return base.with_params(layers).shifted(shift)
