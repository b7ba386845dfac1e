"""Registry of policy networks."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from ..control.network_policy import NetworkPolicy
from ..control.policy import AbstractPolicy
from ..control.thrust_network import ThrustNetwork
from ..errors import ConfigError
from ..physics.vehicle import Vehicle
from .initialisers import make_untrained_policy
from .presets import Preset
from .registry import Registry


@dataclass(frozen=True)
class NetworkRequest:
    """The inputs from which an untrained network is built."""

    preset: Preset
    size: int
    """Length of the observation."""
    vehicle: Vehicle
    """Vehicle with the command limits."""
    key: Key[Array, ""]
    """Random key; consumed."""

    @property
    def hidden_sizes(self) -> tuple[int, ...]:
        """Widths of the hidden layers in the preset."""
        return tuple(self.preset.pretrain.hidden_sizes)


NETWORKS: Registry[Callable[[NetworkRequest], Any]] = Registry(
    "network", example="module:name of a function", expected="a function of a NetworkRequest"
)
register_network = NETWORKS.register


def make_policy(request: NetworkRequest) -> AbstractPolicy:
    """Build the untrained policy of a preset.

    A network that is not an :class:`~retrim.AbstractPolicy` becomes a :class:`~retrim.NetworkPolicy`.

    Raises:
        ConfigError: There is no such network, or the network does not map an observation to four numbers.
    """
    name = request.preset.pretrain.network
    network = NETWORKS.find(name)(request)
    if isinstance(network, AbstractPolicy):
        return network
    if not (isinstance(network, eqx.Module) and callable(network)):
        raise ConfigError(f"network {name!r} returns {type(network).__name__}, expected a callable equinox.Module")
    observation = jax.ShapeDtypeStruct((request.size,), jnp.zeros(()).dtype)
    try:
        shape = jnp.shape(eqx.filter_eval_shape(network, observation))
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"network {name!r} cannot be called with an observation of {request.size} numbers: "
            f"{str(error).splitlines()[0]}"
        ) from error
    if shape != (4,):
        raise ConfigError(f"network {name!r} returns an array of shape {shape}, expected (4,)")
    return NetworkPolicy.create(network, request.vehicle)


def _perceptron(request: NetworkRequest) -> AbstractPolicy:
    policy: AbstractPolicy = make_untrained_policy(request.size, request.vehicle, request.key, request.hidden_sizes)
    return policy


def _thrust(request: NetworkRequest) -> ThrustNetwork:
    table = request.preset.track
    if table is None or table.observation != "thrust":
        raise ConfigError("network 'thrust' needs [track] observation = 'thrust'")
    return ThrustNetwork.of(request.size, request.vehicle, request.key, request.hidden_sizes)


register_network("mlp", _perceptron)
register_network("thrust", _thrust)
