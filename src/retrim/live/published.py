"""What learners keep on the bus beside parameters: whole updates, with optimiser states, to go on from.

Two versions of each layer stay: the last one, and the newest one that is flown.
"""

import contextlib
from collections.abc import Callable
from typing import Any

from ..adapt.learner import LearnerState
from ..adapt.updates import PolicyUpdate, ResidualUpdate, Update, pack_update, unpack_update
from ..errors import MessageError
from ..onboard.topics import LAYERS, SLOTS, slot
from ..transport.bus import Bus, Message

PREFIX = 8  # bytes of the version before an update


def keep(bus: Bus, layer: str, version: int, update: Update, status: dict[str, Any]) -> None:
    """Publish an update in place of the one before the last, but never of the one that is flown: nobody may take it.

    Args:
        bus: Where it is published.
        layer: Which one.
        version: Of the update.
        update: What to keep.
        status: Last report of the process that flies.
    """
    held = [_version(bus.latest(slot(layer, i))) for i in range(SLOTS)]
    place, flown = version % SLOTS, max(filter(_flies(layer, status), held), default=0)
    if flown and held[place] == flown:
        place = (place + 1) % SLOTS
    bus.publish(slot(layer, place), version.to_bytes(PREFIX, "little") + pack_update(update))


def newest_update(bus: Bus, state: LearnerState, layer: str, after: int = 0) -> tuple[int, Update] | None:
    """Return the newest update of a layer with its version, if it is newer than ``after``."""
    return _newest(bus, state, layer, lambda version: version > after)


def flown_update(bus: Bus, state: LearnerState, layer: str, status: dict[str, Any]) -> tuple[int, Update] | None:
    """Return the newest update of a layer that is flown, with its version; None if there is none any more.

    Args:
        bus: Where updates are published.
        state: What they should look like.
        layer: Which one.
        status: Last report of the process that flies.
    """
    return _newest(bus, state, layer, _flies(layer, status))


def learnt_from(bus: Bus, state: LearnerState, status: dict[str, Any]) -> LearnerState | None:
    """Return what was learnt and flown last; None if nothing was.

    Args:
        bus: Of the flight.
        state: What the learners went on from.
        status: Last report of the process that flies.
    """
    fit, policy = (flown_update(bus, state, layer, status) for layer in LAYERS)
    found = state
    if fit is not None and isinstance(fit[1], ResidualUpdate):
        found = LearnerState(found.policy, fit[1].state)
    if policy is not None and isinstance(policy[1], PolicyUpdate):
        found = LearnerState(policy[1].state, found.residual)
    return None if fit is None and policy is None else found


def _flies(layer: str, status: dict[str, Any]) -> Callable[[int], bool]:
    """Return what tells whether a version has taken over and was not taken back."""
    newest = status.get("newest", {}).get(layer, 0)
    given_up = status.get("given_up", []) if layer == "policy" else []
    return lambda version: version <= newest and version not in given_up


def _version(message: Message | None) -> int:
    return 0 if message is None else int.from_bytes(message.data[:PREFIX], "little")


def _newest(bus: Bus, state: LearnerState, layer: str, wanted: Callable[[int], bool]) -> tuple[int, Update] | None:
    found: list[tuple[int, Update]] = []
    for i in range(SLOTS):
        message = bus.latest(slot(layer, i))
        if message is None or not wanted(version := _version(message)):
            continue
        with contextlib.suppress(MessageError):
            found.append((version, unpack_update(message.data[PREFIX:], state, source=layer)))
    return max(found, key=lambda each: each[0], default=None)
