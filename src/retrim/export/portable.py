"""Build the portable form of a policy: weights in single precision, limits, the observation, and test vectors."""

from dataclasses import dataclass
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random
from jaxtyping import Array, Float

from ..config.setup import Setup
from ..control.controller import PolicyController
from ..control.policy import AbstractPolicy
from ..errors import ConfigError
from ..io.checkpoint import fingerprint
from ..physics import so3
from ..physics.state import STANDARD_GRAVITY, State
from ..tasks.observation import POSITION_SCALE, VELOCITY_SCALE, StateObs

M = TypeVar("M", bound=eqx.Module)
TESTS = 4
FLIGHT = 4  # ticks of the test flight, in addition to the length of the history


@dataclass(frozen=True)
class Portable:
    """A policy as NumPy arrays in single precision.

    The command is u = low + (high - low) / (1 + exp(-(y + y0))), with the network output y.
    """

    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Weights (inputs, outputs) and biases; a ReLU follows each layer except the last."""
    low: np.ndarray
    """Smallest command: c [m/s^2] and omega [rad/s]."""
    high: np.ndarray
    y0: np.ndarray
    """Offset of the network output, with which a zero output commands hover."""
    observation: dict[str, Any] | None
    """Parameters of the state observation; None if the observation depends on more than the state."""
    about: dict[str, Any]
    """Preset, task, control tick [s], and a hash of the weights."""
    test_observations: np.ndarray
    test_commands: np.ndarray
    test_states: np.ndarray
    """States [p, R, v] of a test flight, (ticks, 15); no rows if the observation depends on more than the state."""
    test_flight: np.ndarray
    """Commands of the policy's controller in the test flight, (ticks, 4)."""

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sizes of the layers, from the observation to the command."""
        return (self.layers[0][0].shape[0], *(w.shape[1] for w, _ in self.layers))


def portable_of(policy: AbstractPolicy, setup: Setup) -> Portable:
    """Return the portable form of a policy.

    Args:
        policy: Policy to export; a low-rank policy must be merged first.
        setup: Set-up with the policy's preset, vehicle and task.

    Raises:
        ConfigError: The policy is not a perceptron.
    """
    if not policy.linear_layers():
        network = setup.preset.pretrain.network
        raise ConfigError(f"export needs a perceptron (pretrain.network = 'mlp'), and this policy has {network!r}")
    single = [(_single(l.weight.T), _single(l.bias)) for l in policy.linear_layers()]
    low, high, hover = (_single(u.vector()) for u in (policy.u_min, policy.u_max, policy.u_hover))
    preset, sensor = setup.preset, setup.env.task.observation
    observation, states, flight = None, np.zeros((0, 15), np.float32), np.zeros((0, 4), np.float32)
    if isinstance(sensor, StateObs):
        states = _states(sensor, FLIGHT + sensor.history, seed=0)
        flight = np.asarray(_fly(_in_single(PolicyController(sensor, policy)), jnp.asarray(states)))
        observation = {
            "origin": sensor.origin.tolist(), "rates_max": sensor.omega_max.tolist(), "history": sensor.history,
            "position_scale": POSITION_SCALE, "velocity_scale": VELOCITY_SCALE, "gravity": STANDARD_GRAVITY,
        }  # fmt: skip
    about = {"preset": preset.name, "task": preset.task, "dt": preset.dt, "weights": fingerprint(policy)}
    tests = observations(single[0][0].shape[0], TESTS, seed=0)
    return Portable(
        tuple(single), low, high, np.log((hover - low) / (high - hover)), observation, about, tests,
        commands(policy, tests), states, flight,
    )  # fmt: skip


def observations(size: int, n: int, seed: int) -> np.ndarray:
    """Return ``n`` random observations, drawn from a standard normal distribution in single precision."""
    return np.asarray(random.normal(random.key(seed), (n, size), dtype=jnp.float32))


def commands(policy: AbstractPolicy, rows: np.ndarray) -> np.ndarray:
    """Return the commands that JAX computes for rows of observations, in single precision."""
    return np.asarray(_commands(_in_single(policy), jnp.asarray(rows)))


@eqx.filter_jit
def _commands(policy: AbstractPolicy, rows: Float[Array, "n o"]) -> Float[Array, "n 4"]:
    return jax.vmap(lambda o: policy(o).vector())(rows)


def _states(sensor: StateObs, ticks: int, seed: int) -> np.ndarray:
    """Return random states near the origin of an observation, (ticks, 15), in single precision."""
    p, phi, v = np.asarray(random.normal(random.key(seed), (3, ticks, 3), dtype=jnp.float32))
    R = np.asarray(jax.vmap(so3.exp)(jnp.asarray(0.5 * phi, jnp.float32))).reshape(ticks, 9)
    return np.concatenate([np.asarray(sensor.origin) + 0.5 * p, R, v], axis=1).astype(np.float32)


@eqx.filter_jit
def _fly(controller: PolicyController, rows: Float[Array, "n 15"]) -> Float[Array, "n 4"]:
    """Return the commands of a controller for consecutive states."""

    def state(row: Float[Array, "15"]) -> State:
        return State(row[:3], row[3:12].reshape(3, 3), row[12:])

    def tick(memory: Any, row: Float[Array, "15"]) -> tuple[Any, Float[Array, "4"]]:
        u, memory = controller(memory, jnp.zeros((), jnp.float32), state(row))
        return memory, u.vector()

    return lax.scan(tick, controller.init(state(rows[0])), rows)[1]


def _in_single(module: M) -> M:
    """Return a module with its arrays in single precision."""
    out: M = jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if eqx.is_array(leaf) else leaf, module)
    return out


def _single(leaf: Any) -> np.ndarray:
    return np.ascontiguousarray(np.asarray(leaf), dtype=np.float32)
