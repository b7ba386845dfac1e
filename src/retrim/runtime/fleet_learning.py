"""Learning for many vehicles at once: whatever is due, as one program."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from ..adapt.updates import Update
from ..adapt.workers import PolicyWorker, ResidualWorker, Worker, policy_update, residual_update
from ..learn.devices import spread
from ..learn.window import Window
from .batch_learning import fit_all, update_all
from .batched import one, stacked


def learn_together(workers: Sequence[Worker], windows: Sequence[Window]) -> list[Update]:
    """Learn from a window for each of several vehicles; the result of each is that of its worker alone, to rounding.

    Programs are compiled for powers of two; what is missing to the next one is computed twice and dropped, so that any
    number of vehicles may be due.

    Args:
        workers: One for each vehicle, of one layer and one learner, with states of one structure.
        windows: What each learns from.

    Returns:
        The update of each.
    """
    first, n = workers[0], len(workers)
    filled = [*range(n), *[0] * (room_for(n) - n)]
    window = stacked([windows[i] for i in filled])
    if isinstance(first, ResidualWorker):
        states, reports = fit_all(first.learner, stacked([_state(workers[i]) for i in filled]), window)
        reports, t = jax.device_get((reports, window.t[:, -1]))
        return [residual_update(float(t[i]), one(states, i), _row(reports, i)) for i in range(n)]
    assert isinstance(first, PolicyWorker)
    keys = [worker.next_key() for worker in workers if isinstance(worker, PolicyWorker)]
    state = stacked([_state(workers[i]) for i in filled])
    trained, verdicts = update_all(first.learner, state, window, spread(jnp.stack([keys[i] for i in filled])))
    verdicts, t = jax.device_get((verdicts, window.t[:, -1]))
    return [policy_update(float(t[i]), one(trained, i), _row(verdicts, i)) for i in range(n)]


def room_for(n: int) -> int:
    """Return the size of the program for ``n`` vehicles: the next power of two."""
    return 1 << (n - 1).bit_length()


def _state(worker: Worker) -> Any:
    assert isinstance(worker, ResidualWorker | PolicyWorker)
    return worker.state


def _row(tree: Any, i: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[i], tree)
