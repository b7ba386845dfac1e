"""Frozen, typed messages from learners to pilots, with conversion to bytes and back."""

import json
import math
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

import numpy as np

from ..errors import MessageError
from ..learn.bptt import PolicyState
from ..learn.screening import REASONS, describe_counts
from ..transport import wire
from .gate import Verdict
from .learner_state import FitReport, LearnerState

Layer = Literal["residual", "policy"]
"""The two layers of learning."""
Counts = tuple[int, ...]
NO_REJECTIONS: Counts = (0,) * len(REASONS)


@dataclass(frozen=True)
class ResidualUpdate:
    """Message that a residual was fitted."""

    computed_from: float
    """Time of the newest measurement from which the residual was learned [s]."""
    rms_error: float
    """Root mean square of the fit's error [m/s^2]."""
    state: Any
    """New state of the residual model."""
    excluded: Counts = NO_REJECTIONS
    """Number of steps that were excluded from the fit, by reason; see :class:`~retrim.learn.screening.Screening`."""

    def note(self) -> str:
        """Return one line for the log."""
        fit = f"rms error {self.rms_error:.3f} m/s^2"
        return (
            f"{fit}; measurements excluded: {description}" if (description := describe_counts(self.excluded)) else fit
        )


@dataclass(frozen=True)
class PolicyUpdate:
    """Message that a policy was re-trained and admitted."""

    computed_from: float
    """Time of the newest measurement from which the policy was learned [s]."""
    cost: float
    """Cost of the new policy on the gate's roll-outs."""
    incumbent_cost: float
    """Cost of the policy that the new one replaces."""
    state: PolicyState
    """The new policy and its optimiser state."""

    def note(self) -> str:
        """Return one line for the log."""
        return f"cost {self.cost:.4f} against {self.incumbent_cost:.4f}"


@dataclass(frozen=True)
class Rejection:
    """Message that a result must not be used."""

    computed_from: float
    layer: Layer
    reason: str

    def note(self) -> str:
        """Return one line for the log."""
        return self.reason


@dataclass(frozen=True)
class Skip:
    """Message that a window was offered while the learner was busy."""

    computed_from: float
    layer: Layer

    def note(self) -> str:
        """Return one line for the log."""
        return f"{self.layer} learner still busy"


Update = ResidualUpdate | PolicyUpdate | Rejection | Skip
KINDS: dict[type, str] = {ResidualUpdate: "residual", PolicyUpdate: "policy", Rejection: "rejected", Skip: "skipped"}
"""Name of each kind of update in messages and logs."""


def residual_update(computed_from: float, state: Any, report: FitReport) -> ResidualUpdate | Rejection:
    """Return the message for a finished fit."""
    excluded = describe_counts(report.contradictions)
    if not report.accepted:
        reason = "the residual's fit is not finite, or no tick of the window can be used"
        return Rejection(
            computed_from, "residual", f"{reason} (measurements excluded: {excluded})" if excluded else reason
        )
    counts = tuple(np.asarray(report.contradictions).tolist())
    return ResidualUpdate(computed_from, float(report.rms_error), state, counts)


def policy_update(computed_from: float, state: PolicyState, verdict: Verdict) -> PolicyUpdate | Rejection:
    """Return the message for a finished policy update."""
    if not verdict.admitted:
        return Rejection(computed_from, "policy", verdict.reason())
    return PolicyUpdate(computed_from, float(verdict.candidate), float(verdict.incumbent), state)


def pack_update(update: Update) -> bytes:
    """Return the bytes of an update; this is the inverse of :func:`unpack_update`."""
    plain = {f.name: getattr(update, f.name) for f in fields(update) if f.name != "state"}
    return wire.pack(getattr(update, "state", ()), kind=KINDS[type(update)], about={"update": json.dumps(plain)})


def unpack_update(data: bytes, like: LearnerState, *, source: str) -> Update:
    """Read an update.

    Args:
        data: Bytes of a message.
        like: A learner state with the expected structure, shapes and types.
        source: Source of the bytes, for error messages.

    Returns:
        The update.

    Raises:
        MessageError: The message is truncated or damaged, has the wrong kind or shape, or is not finite.
    """
    kind = wire.kind_of(data, source=source)
    types = {name: cls for cls, name in KINDS.items()}
    if kind not in types:
        raise MessageError(f"{source}: holds a {kind!r}, expected one of {', '.join(types)}")
    expected: Any = {"residual": like.residual, "policy": like.policy}.get(kind, ())
    state = wire.unpack(data, expected, kind=kind, source=source)
    try:
        plain = _check_fields(json.loads(wire.describe(data, kind=kind, source=source)["update"]), types[kind])
        update: Update = types[kind](**plain, **({"state": state} if kind in ("residual", "policy") else {}))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise MessageError(f"{source}: not the fields of a {kind!r} update ({error})") from error
    return update


def _check_fields(plain: Any, cls: type) -> dict[str, Any]:
    """Return the plain fields of a message; raise ``TypeError`` or ``ValueError`` with the name of an invalid field."""
    types = {f.name: f.type for f in fields(cls) if f.name != "state"}
    if not isinstance(plain, dict) or plain.keys() != types.keys():
        raise TypeError(f"expected {', '.join(types)}")
    return {name: _field(name, value, types[name]) for name, value in plain.items()}


def _field(name: str, value: Any, kind: Any) -> Any:
    if kind is float:
        # A policy may replace one whose cost was not finite.
        if type(value) not in (int, float) or not (math.isfinite(value) or name == "incumbent_cost"):
            raise ValueError(f"{name} = {value!r} is not a finite number")
        return float(value)
    if kind is Counts:
        if type(value) is not list or len(value) != len(REASONS) or any(type(n) is not int or n < 0 for n in value):
            raise ValueError(f"{name} must be {len(REASONS)} whole numbers of at least 0")
        return tuple(value)
    if not isinstance(value, str) or (kind is Layer and value not in get_args(Layer)):
        raise ValueError(f"{name} = {value!r}")
    return value
