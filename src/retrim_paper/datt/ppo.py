"""Learns from rewards alone, by proximal policy optimisation (Schulman et al. 2017), for problems without gradients.

Many environments are stepped at once. Advantages are estimated as in Schulman et al. 2016. A few passes over the
samples, in minibatches, maximise the clipped objective. If an episode is cut off by the time limit and not by the
vehicle's behaviour, the estimate continues with the value of the state at the cut. Values are sums of rewards scaled
by 1 - gamma, so they have the magnitude of a reward for every discount.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import lax, random
from jaxtyping import Array, Float, Int, Key

from retrim.learn.problem import Problem

from .advantages import Experience, advantages


@runtime_checkable
class ActorCritic(Protocol):
    """A policy with its exploration noise and its value function; an :class:`equinox.Module`."""

    log_std: Float[Array, " a"]
    """Logarithm of the actions' standard deviation."""

    def __call__(self, o: Float[Array, " o"]) -> tuple[Float[Array, " a"], Float[Array, ""]]:
        """Return the mean action and the value for an observation."""
        ...


@dataclass(frozen=True)
class PpoSettings:
    """Sizes and rates for learning."""

    envs: int = 256
    steps: int = 64
    """Steps of each environment between two updates."""
    minibatches: int = 4
    epochs: int = 4
    """Passes over the samples."""
    learning_rate: float = 1e-3
    """Initial learning rate; it decays to zero with a cosine schedule."""
    discount: float = 0.99
    trace: float = 0.95
    """Parameter lambda of the generalised advantage estimates."""
    clip: float = 0.2
    value_cost: float = 0.5
    entropy_gain: float = 0.0
    max_grad_norm: float = 0.5

    def __post_init__(self) -> None:
        """Raise ``ValueError`` if the samples cannot be split into the minibatches."""
        if (self.envs * self.steps) % self.minibatches:
            raise ValueError(f"PPO: {self.envs} x {self.steps} samples cannot be split into {self.minibatches} batches")

    def updates(self, steps: int) -> int:
        """Return the smallest number of updates that take at least ``steps`` steps."""
        return -(-steps // (self.envs * self.steps))


class PpoState(eqx.Module):
    """State of the learning process."""

    net: Any
    """The :class:`ActorCritic`."""
    optimiser: Any
    envs: Any
    """States of the environments."""
    key: Key[Array, ""]
    made: Int[Array, ""]
    """Number of updates so far."""

    @classmethod
    def of(cls, problem: Problem[Any], net: Any, key: Key[Array, ""], settings: PpoSettings) -> "PpoState":
        """Return the state before the first update; the key is consumed."""
        k_reset, k_learn = random.split(key)
        envs = jax.jit(jax.vmap(problem.reset))(random.split(k_reset, settings.envs))
        moments = _optimiser(settings, 1).init(eqx.filter(net, eqx.is_inexact_array))  # the same for any number
        return cls(net, moments, envs, k_learn, jnp.array(0))


def ppo(
    problem: Problem[Any], state: PpoState, settings: PpoSettings, *, steps: int
) -> Iterator[tuple[PpoState, dict[str, float]]]:
    """Learn a policy.

    Args:
        problem: The environment.
        state: State from which learning starts or resumes; a resumed run equals an uninterrupted one bit for bit.
        settings: Sizes and rates.
        steps: Total steps of all environments, counted from the first update.

    Yields:
        The state after each update, and statistics, such as the mean reward per step, the loss and the share of
        clipped samples.
    """
    updates = settings.updates(steps)
    optimiser = _optimiser(settings, updates)
    for _ in range(int(state.made), updates):
        state, figures = update(problem, state, optimiser, settings)
        yield state, {name: float(value) for name, value in figures.items()}


@functools.lru_cache(maxsize=32)
def _optimiser(settings: PpoSettings, updates: int) -> optax.GradientTransformation:
    """Return gradient clipping followed by Adam with a cosine schedule.

    The same arguments return the same object, so compiled programs are shared.
    """
    rate = optax.cosine_decay_schedule(settings.learning_rate, updates * settings.epochs * settings.minibatches)
    return optax.chain(optax.clip_by_global_norm(settings.max_grad_norm), optax.adam(rate, eps=1e-5))


@eqx.filter_jit
def update(
    problem: Problem[Any], state: PpoState, optimiser: optax.GradientTransformation, settings: PpoSettings
) -> tuple[PpoState, dict[str, Float[Array, ""]]]:
    """Step the environments and make one update from the samples."""
    k_next, k_roll, k_epochs = random.split(state.key, 3)
    envs, experience, last, reward = _roll_out(problem, state.net, state.envs, k_roll, settings)
    advantage = advantages(experience, last, settings.discount, settings.trace)
    samples = (experience, advantage, advantage + experience.value)
    size = settings.envs * settings.steps
    flat = jax.tree.map(lambda leaf: leaf.reshape(size, *leaf.shape[2:]), samples)
    arrays, fixed = eqx.partition(state.net, eqx.is_inexact_array)

    def minibatch(carry: Any, rows: Int[Array, " n"]) -> tuple[Any, dict[str, Array]]:
        arrays, moments = carry
        batch = jax.tree.map(lambda leaf: leaf[rows], flat)
        slopes, figures = jax.grad(_loss, has_aux=True)(arrays, fixed, batch, settings)
        steps, moments = optimiser.update(slopes, moments, arrays)
        return (eqx.apply_updates(arrays, steps), moments), figures

    def epoch(carry: Any, key: Key[Array, ""]) -> tuple[Any, dict[str, Array]]:
        order = random.permutation(key, size).reshape(settings.minibatches, -1)
        return lax.scan(minibatch, carry, order)

    keys = random.split(k_epochs, settings.epochs)
    (arrays, moments), figures = lax.scan(epoch, (arrays, state.optimiser), keys)
    mean = {name: jnp.mean(values) for name, values in figures.items()}
    after = PpoState(eqx.combine(arrays, fixed), moments, envs, k_next, state.made + 1)
    return after, {"reward": reward, **mean}


def log_prob(action: Float[Array, " a"], mean: Float[Array, " a"], log_std: Float[Array, " a"]) -> Float[Array, ""]:
    """Return the log-density of an action that is normally distributed around ``mean``."""
    standard = (action - mean) * jnp.exp(-log_std)
    return jnp.sum(-0.5 * standard * standard - log_std) - 0.5 * action.shape[0] * jnp.log(2.0 * jnp.pi)


def _roll_out(
    problem: Problem[Any], net: Any, envs: Any, key: Key[Array, ""], settings: PpoSettings
) -> tuple[Any, Experience, Float[Array, " envs"], Float[Array, ""]]:
    """Step all environments; when an episode ends, its environment begins a new one."""

    def one(s: Any, key: Key[Array, ""]) -> tuple[Any, tuple[Experience, Array]]:
        k_see, k_act, k_step, k_new, k_after = random.split(key, 5)
        o = problem.observe(s, k_see)
        mean, value = net(o)
        action = mean + jnp.exp(net.log_std) * random.normal(k_act, mean.shape, mean.dtype)
        after, outcome = problem.step(s, action, k_step)
        beyond = settings.discount * net(problem.observe(after, k_after))[1]
        cut = outcome.truncated & ~outcome.terminated
        reward = (1.0 - settings.discount) * outcome.reward + jnp.where(cut, beyond, 0.0)
        over, fresh = outcome.terminated | outcome.truncated, problem.reset(k_new)
        s = jax.tree.map(lambda new, old: jnp.where(over, new, old), fresh, after)
        experience = Experience(o, action, log_prob(action, mean, net.log_std), value, outcome._replace(reward=reward))
        return s, (experience, outcome.reward)

    def step(envs: Any, key: Key[Array, ""]) -> tuple[Any, tuple[Experience, Array]]:
        return jax.vmap(one)(envs, random.split(key, settings.envs))

    k_steps, k_last = random.split(key)
    envs, (experience, rewards) = lax.scan(step, envs, random.split(k_steps, settings.steps))
    last = jax.vmap(lambda s, k: net(problem.observe(s, k))[1])(envs, random.split(k_last, settings.envs))
    return envs, experience, last, jnp.mean(rewards)


def _loss(arrays: Any, fixed: Any, batch: Any, settings: PpoSettings) -> tuple[Array, dict[str, Array]]:
    """Return the loss, which contains the negative clipped objective, and statistics."""
    net, (experience, advantage, target) = eqx.combine(arrays, fixed), batch
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
    mean, value = jax.vmap(net)(experience.o)
    now = jax.vmap(log_prob, in_axes=(0, 0, None))(experience.action, mean, net.log_std)
    ratio = jnp.exp(now - experience.log_prob)
    clipped_ratio = jnp.clip(ratio, 1.0 - settings.clip, 1.0 + settings.clip)
    gain = jnp.mean(jnp.minimum(ratio * advantage, clipped_ratio * advantage))
    value_error = jnp.mean((value - target) ** 2)
    entropy = jnp.sum(net.log_std)
    loss = -gain + settings.value_cost * value_error - settings.entropy_gain * entropy
    return loss, {"loss": loss, "clipped": jnp.mean(jnp.abs(ratio - 1.0) > settings.clip), "missed": value_error}
