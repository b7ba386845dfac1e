"""Process of the page, which shows a flight and its knobs in a browser. The page never blocks the flight."""

import contextlib
import io
import re
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ...control.condition import describe_condition
from ...errors import ConfigError, MessageError, excerpt
from ...learn.screening import describe_counts
from ...onboard.heartbeat import Heart
from ...onboard.messages import Sample, last_note, last_send_time, pack_note
from ...onboard.note_fields import FIELDS, format_value, plain, read_fields
from ...onboard.realtime import ParentWatch
from ...transport.bus import Bus
from ...transport.remote import LOOPBACK
from ...transport.shared_memory import SharedMemoryBus
from ..refused_notes import PAGE
from ..spec import PageSpec
from .manual_disturbance import ManualDisturbance
from .page_access import only_for
from .page_input import take_values_only
from .panel import Panel
from .scene import Scene

RATE = 20.0  # [Hz]
TEXT_EVERY = 5  # [refreshes]
CONTROLLER_TEXTS = {
    "policy": " (network with its updates)",
    "hold": " (the guard, which holds the vehicle, and lands it then)",
    "descend": " (the guard, which lands)",
    "blind": " (the guard, without a measurement)",
    "drop": " (the guard, which stopped the motors after two seconds without a measurement)",
}
"""Explanations of the mode names."""
NO_ROTATION = 0.1  # largest error of R R^T for which an attitude is drawn
COORDINATE_LIMIT = 1e6  # [m], limit on drawn coordinates


@dataclass(frozen=True)
class PagePlan:
    """Arguments of the process."""

    folder: Path
    """Folder of the bus."""
    page: PageSpec
    parent: int


HOST = re.compile(r"(?:[\w-]{1,63}\.){0,9}[\w-]{1,63}|(?=.*:)[\da-fA-F:.]{2,45}(?:%\w{1,15})?", re.ASCII)


def free_port(host: str, first_port: int) -> int:
    """Return the first free port of ``host`` among the ten ports from ``first_port`` on.

    Raises:
        ConfigError: All ten ports are in use, or ``host`` is not an address of this machine.
    """
    if not HOST.fullmatch(host):
        raise ConfigError(f"--page-host {excerpt(host)}: neither an address nor the name of a host")
    reason = ""
    for port in range(first_port, min(first_port + 10, 65536)):
        try:
            with socket.create_server((host, port)):
                return port
        except (OSError, ValueError) as error:  # not every text is a valid host name
            reason = str(getattr(error, "strerror", None) or error)[:160]
    raise ConfigError(f"page: no free port from {first_port} on at {excerpt(host)} ({reason})")


def page_address(host: str, port: int, *, is_explicit: bool, say: Callable[[str], None]) -> tuple[str, int] | None:
    """Return the host and port of a page; None if viser is not installed and the page was not requested.

    Args:
        host: Address to listen on.
        port: First port to try.
        is_explicit: Whether the user explicitly requested a page.
        say: Function that is called with messages for the user.

    Raises:
        ConfigError: The port is out of range, or a requested page cannot be shown.
    """
    if not 1 <= port <= 65535:
        raise ConfigError(f"--page-port {port} must be between 1 and 65535")
    if find_spec("viser") is None:
        if is_explicit:
            raise ConfigError("--page needs viser: pip install viser")
        say("no page in the browser: pip install viser brings it")
        return None
    free_port(host, port)
    if host not in LOOPBACK:
        say(
            f"warning: the page listens on {host}; anyone who has its printed address can turn the knobs and land "
            "the vehicle, and it travels unencrypted"
        )
    return host, port


def show(plan: PagePlan) -> None:
    """Show the flight until the process is terminated; this is the main function of the process."""
    import viser

    bus, parent, spec = SharedMemoryBus(plan.folder), ParentWatch(plan.parent), plan.page
    # Both viser and retrim print the address: discard viser's output.
    with contextlib.redirect_stdout(io.StringIO()), only_for(spec.token, spec.host):
        server = viser.ViserServer(host=spec.host, port=spec.port, label=f"retrim: {spec.name}", verbose=False)
    page = _Page(spec, bus, server)
    take_values_only(server, page.refuse)
    bus.publish("ready.page", pack_note("ready", port=server.get_port()))
    refreshes, heart = 0, Heart(bus, "page")
    while not parent.has_ended(1.0 / RATE):
        heart.beat()
        try:
            page.refresh(text=refreshes % TEXT_EVERY == 0)
        except Exception as error:  # the landing button must work even if a refresh fails
            page.refuse(f"{type(error).__name__}: {error}")
        refreshes += 1
    server.stop()


class _Page:
    """Reads the bus for the scene and the panel, and publishes the user's actions."""

    def __init__(self, spec: PageSpec, bus: Bus, server: Any) -> None:
        self._bus, self._lock = bus, threading.Lock()
        self._spec = spec
        self._refusals = 0
        self._wishes = dict[str, Any]()
        for name, value in last_note(self._bus, "wish").items():  # from an earlier page process
            with contextlib.suppress(MessageError):
                self._wishes |= self._possible({name: value})
        self._scene = Scene(server, spec.path, spec.arm, RATE)
        self._paths, self._reference = spec.paths, ""
        self._panel = Panel(
            server,
            self._turn,
            self._wish,
            self._knobs(),
            self._wishes,
            spec.methods,
            tuple(spec.paths),
            spec.mass,
            RATE,
            _escape(f"Scenario: {spec.world}."),
        )
        self._scene.on_pull(self._panel.pull)
        self._tick = -1

    def refresh(self, *, text: bool) -> None:
        """Update the scene and the panel from new messages."""
        status, sample = last_note(self._bus, "status"), self._sample()
        if sample is not None and sample.tick != self._tick:
            self._tick = sample.tick
            disturbance, estimate = (
                _bound_vector(status.get(name, (0.0, 0.0, 0.0))) for name in ("disturbance", "estimate")
            )
            target, R = _bound_vector(status.get("target", sample.state[:3])), sample.truth[3:12].reshape(3, 3)
            if np.abs(R).max() < COORDINATE_LIMIT and np.allclose(R @ R.T, np.eye(3), atol=NO_ROTATION):
                self._scene.move(_bound_vector(sample.truth[:3]), R, target, disturbance, estimate)
            policies = int(status.get("newest", {}).get("policy", 0))
            self._panel.note(sample.t, float(np.linalg.norm(_bound_vector(sample.truth[:3]) - target)), policies)
        if text and (reference := last_note(self._bus, "followed").get("name", "")) != self._reference:
            self._reference = reference
            if reference in self._paths:
                self._scene.follow(self._paths[reference])
        if text and status:
            if last_send_time(self._bus, "fallback") > last_send_time(self._bus, "setpoint"):
                status["mode"], status["reason"] = "watchdog", "the process that flew is gone or hangs"
            self._panel.show(
                _text(status, last_note(self._bus, "ended"), self._learners(), last_note(self._bus, "world"))
            )

    def _sample(self) -> Sample | None:
        message = self._bus.latest("sample")
        with contextlib.suppress(MessageError):
            return None if message is None else Sample.unpack(message.data)
        return None

    def _learners(self) -> dict[str, dict[str, Any]]:
        result = {layer: last_note(self._bus, f"learner.{layer}") for layer in ("residual", "policy")}
        return {layer: note for layer, note in result.items() if note}

    def _knobs(self) -> ManualDisturbance:
        """Return the positions of the knobs."""
        message = self._bus.latest("knobs")
        with contextlib.suppress(MessageError):
            return ManualDisturbance() if message is None else ManualDisturbance.unpack(message.data)
        return ManualDisturbance()

    def refuse(self, why: str) -> None:
        """Count a refused input and publish the count with the reason."""
        self._refusals += 1
        with contextlib.suppress(MessageError):
            self._bus.publish(PAGE, pack_note(PAGE, count=self._refusals, last=plain(why)))

    def _turn(self, change: Callable[[ManualDisturbance], ManualDisturbance]) -> ManualDisturbance | None:
        """Set the knobs relative to their current positions; return the current positions if the change fails.

        This method may be called from any thread.
        """
        with self._lock:
            before = self._knobs()
            try:
                self._bus.publish("knobs", change(before).pack())
            except (MessageError, KeyError, TypeError, ValueError, OverflowError) as error:
                self.refuse(f"{error}" if isinstance(error, MessageError) else f"knobs: {type(error).__name__}")
                return before
        return None

    def _wish(self, **wish: Any) -> dict[str, Any]:
        """Publish a user request; return all current requests."""
        first = {"method": next(iter(self._spec.methods), "none"), "paused": False}
        with self._lock:
            try:
                self._wishes |= self._possible(wish)
                self._bus.publish("wish", pack_note("wish", **self._wishes))
            except MessageError as error:
                self.refuse(str(error))
            return first | {"reference": next(iter(self._paths), "")} | self._wishes

    def _possible(self, wish: dict[str, Any]) -> dict[str, Any]:
        """Check a request, and return its known fields.

        Raises:
            MessageError: A field has the wrong type, or its value is not among the choices.
        """
        result = read_fields("wish", {name: value for name, value in wish.items() if name in FIELDS["wish"]})
        for name, there in (("method", (*self._spec.methods, "none")), ("reference", tuple(self._spec.paths))):
            if name in result and result[name] not in there:
                raise MessageError(f"wish: {name} = {format_value(result[name])} is not among {', '.join(there)}")
        return result


def _text(
    status: dict[str, Any], end_note: dict[str, Any], learners: dict[str, dict[str, Any]], world: dict[str, Any]
) -> str:
    reason = f": {_escape(status['reason'])}" if status.get("reason") else ""
    mode = status.get("mode", "not known")
    lines = [f"in control: **{_escape(mode)}**{reason or _escape(CONTROLLER_TEXTS.get(mode, ''))}"]
    if end_note:
        lines = [f"**flight over**: {_escape(end_note.get('reason', ''))}"]
    versions = status.get("versions", {})
    if "policy" in versions:
        lines.append(f"policy updates in use: {versions['policy']}, rolled back: {len(status.get('given_up', []))}")
    lines.append(f"error {100.0 * status.get('error', 0.0):.1f} cm, missed ticks {status.get('missed', 0)}")
    disturbance, estimate = (_arrow(status.get(name, [])) for name in ("disturbance", "estimate"))
    lines.append(f"<span style='color:#d64541'>disturbance</span> {disturbance} m/s²")
    lines.append(f"<span style='color:#3070d6'>estimate</span> {estimate} m/s²")
    for layer, note in learners.items():
        results, took = note.get("learnt", 0), 1e3 * note.get("took", 0.0)
        lines.append(f"{layer} learner: {results} results, last in {took:.0f} ms")
    if exclusions := describe_counts(learners.get("residual", {}).get("excluded", [])):
        lines.append(f"measurements excluded from the fit: {exclusions}")
    for at, stage, cause in status.get("stages", [])[-1:]:
        if stage:
            lines.append(f"since {at:.1f} s {describe_condition(stage, cause)}")
    if not status.get("learning", True):
        lines.append("the policy from take-off is in use, without updates")
    if world.get("knobs_refused"):
        lines.append(f"knobs refused: {_escape(world['knobs_refused'])}")
    return "<br>".join(lines)


def _bound_vector(vector: Any) -> np.ndarray:
    """Return a vector for drawing, with finite and bounded values, whatever values were reported."""
    bounded_vector: np.ndarray = np.clip(
        np.nan_to_num(np.asarray(vector, dtype=float)), -COORDINATE_LIMIT, COORDINATE_LIMIT
    )
    return bounded_vector


def _escape(text: str) -> str:
    """Return a text with its Markdown markup escaped so that the text is shown literally."""
    return "".join(c if c.isalnum() or c in " ,.:;()'+-/%=" else f"&#{ord(c)};" for c in plain(text))


def _arrow(a: list[float]) -> str:
    return " ".join(f"{value:+.2f}" for value in a)
