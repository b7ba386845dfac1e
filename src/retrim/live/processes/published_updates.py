"""Keep full updates, including optimiser states, on the bus in addition to parameters.

A restarted learner continues from such an update. The bus holds two updates of each layer; the newest update in flight
is always one of them.
"""

import contextlib
from collections.abc import Callable
from typing import Any

from ...adapt.learner_state import LearnerState
from ...adapt.updates import PolicyUpdate, ResidualUpdate, Update, pack_update, unpack_update
from ...errors import MessageError
from ...onboard.topics import LAYERS, SLOTS, slot
from ...transport.bus import Bus, Message

PREFIX = 8  # [bytes], length of the version that precedes an update


def keep(bus: Bus, layer: str, version: int, update: Update, status: dict[str, Any]) -> None:
    """Publish an update in place of an older one, but never in place of the one in flight.

    The update in flight must remain, since control may not accept the new update.

    Args:
        bus: Bus of the flight.
        layer: Layer of the update.
        version: Version of the update.
        update: Update to publish.
        status: Last status of the control process.
    """
    versions = [_version(bus.latest(slot(layer, i))) for i in range(SLOTS)]
    place, active = version % SLOTS, max(filter(_flies(layer, status), versions), default=0)
    if active and versions[place] == active:
        place = (place + 1) % SLOTS
    bus.publish(slot(layer, place), version.to_bytes(PREFIX, "little") + pack_update(update))


def newest_update(bus: Bus, state: LearnerState, layer: str, after: int = 0) -> tuple[int, Update] | None:
    """Return the newest update of a layer with its version; None if the update is not newer than ``after``."""
    return _newest(bus, state, layer, lambda version: version > after)


def active_update(bus: Bus, state: LearnerState, layer: str, status: dict[str, Any]) -> tuple[int, Update] | None:
    """Return the newest update of a layer in flight with its version; None if that update is not on the bus.

    Args:
        bus: Bus of the flight.
        state: State with the expected structure.
        layer: Layer of the update.
        status: Last status of the control process.
    """
    return _newest(bus, state, layer, _flies(layer, status))


def active_learner_state(bus: Bus, state: LearnerState, status: dict[str, Any]) -> LearnerState | None:
    """Return the last learned state that was used in flight; None if no update was used.

    Args:
        bus: Bus of the flight.
        state: Initial state of the learners.
        status: Last status of the control process.
    """
    fit, policy = (active_update(bus, state, layer, status) for layer in LAYERS)
    result = state
    if fit is not None and isinstance(fit[1], ResidualUpdate):
        result = LearnerState(result.policy, fit[1].state)
    if policy is not None and isinstance(policy[1], PolicyUpdate):
        result = LearnerState(policy[1].state, result.residual)
    return None if fit is None and policy is None else result


def _flies(layer: str, status: dict[str, Any]) -> Callable[[int], bool]:
    """Return a function that checks whether control has accepted a version and has not rolled that version back."""
    newest = status.get("newest", {}).get(layer, 0)
    withdrawals = status.get("given_up", []) if layer == "policy" else []
    return lambda version: version <= newest and version not in withdrawals


def _version(message: Message | None) -> int:
    return 0 if message is None else int.from_bytes(message.data[:PREFIX], "little")


def _newest(bus: Bus, state: LearnerState, layer: str, condition: Callable[[int], bool]) -> tuple[int, Update] | None:
    result: list[tuple[int, Update]] = []
    for i in range(SLOTS):
        message = bus.latest(slot(layer, i))
        if message is None or not condition(version := _version(message)):
            continue
        with contextlib.suppress(MessageError):
            result.append((version, unpack_update(message.data[PREFIX:], state, source=layer)))
    return max(result, key=lambda each: each[0], default=None)
