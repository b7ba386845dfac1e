"""Choose the starts of an update's roll-outs."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Float, Key

from ..learn.pretrain import random_starts
from ..learn.window import Window
from ..physics.state import State
from ..tasks.task import AbstractTask, Start


class AbstractStarts(eqx.Module):
    """Source of an update's starts."""

    @abc.abstractmethod
    def __call__(self, task: AbstractTask, window: Window, key: Key[Array, ""], updates: int, envs: int) -> Start:
        """Return starts with two leading axes, updates x environments; the key is consumed."""

    def recent(self, task: AbstractTask, window: Window, key: Key[Array, ""], n: int) -> Start:
        """Return ``n`` starts on which an update is judged; by default, states of the window. The key is consumed."""
        del task
        return sample_starts(window, key, (n,))


class TaskStarts(AbstractStarts):
    """Uses the starts of pretraining (as in the paper)."""

    def __call__(self, task: AbstractTask, window: Window, key: Key[Array, ""], updates: int, envs: int) -> Start:
        """Draw the starts from the task."""
        return random_starts(task, key, updates, envs)


class TaskOnlyStarts(TaskStarts):
    """Uses only starts of the task, for a task whose times are not those of the flight."""

    def recent(self, task: AbstractTask, window: Window, key: Key[Array, ""], n: int) -> Start:
        """Draw the starts from the task."""
        return jax.vmap(task.reset)(random.split(key, n))


class WindowStarts(AbstractStarts):
    """Most starts come from recent states of the flight, the others from the task, so that the policy does not forget.

    With few environments, distant starts give noisy gradients, and the resulting policy jitters by centimetres.
    """

    spread: Float[Array, ""]
    """Standard deviation of the noise that is added to position [m] and velocity [m/s]."""
    from_task: int = eqx.field(static=True, default=2)
    """Number of environments per step whose starts are drawn from the task."""

    def __call__(self, task: AbstractTask, window: Window, key: Key[Array, ""], updates: int, envs: int) -> Start:
        """Draw the starts from the window and from the task."""
        k_task, k_rows, k_p, k_v = random.split(key, 4)
        far = min(self.from_task, envs)
        shape = (updates, envs - far)
        dtype = window.x.p.dtype
        dp, dv = (self.spread * random.normal(k, (*shape, 3), dtype) for k in (k_p, k_v))
        near = jax.vmap(jax.vmap(_shift))(sample_starts(window, k_rows, shape), dp, dv)
        both: Start = jax.tree.map(
            lambda a, b: jnp.concatenate([a, b], axis=1), random_starts(task, k_task, updates, far), near
        )
        return both


def sample_starts(window: Window, key: Key[Array, ""], shape: tuple[int, ...]) -> Start:
    """Draw states, with the times at which they were true, from the valid part of the window; the key is consumed."""
    weight = window.valid.astype(window.x.p.dtype)
    row = random.choice(key, window.valid.shape[0], shape, p=weight / jnp.sum(weight))
    make: Callable[..., Start] = Start
    for _ in shape:
        make = jax.vmap(make)
    t = window.t if window.age is None else window.t - window.age
    return make(t[row], jax.tree.map(lambda leaf: leaf[row], window.x))


def _shift(start: Start, dp: Float[Array, "3"], dv: Float[Array, "3"]) -> Start:
    return Start(start.t, State(start.x.p + dp, start.x.R, start.x.v + dv))
