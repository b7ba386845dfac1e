"""Ground station: learners on a different machine from the control process."""

import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack
from pathlib import Path
from subprocess import Popen
from typing import Any

from ..errors import ConfigError, MessageError, RetrimError, one_line
from ..onboard.heartbeat import beat_topic
from ..onboard.launch import last_words, launch
from ..onboard.messages import last_note, pack_note
from ..onboard.pulses import Pulses
from ..onboard.topics import INPUT_TOPICS, NETWORK_SIZES, OUTPUT_TOPICS
from ..transport.bridge import Bridge
from ..transport.network import DISTRUST, FAREWELL
from ..transport.remote import Address
from ..transport.shared_memory import SharedMemoryBus
from .learner_mission import LearnerMission
from .processes.fleet import FleetProcess, FleetSlot
from .processes.learner import LearnerPlan
from .roles import ROLES

IDLE, IDLE_BEFORE_FLIGHT = 0.002, 0.05  # [s] between two reads of a bus, during a flight and before the flight
HEARTBEAT_PERIOD = REPORT_PERIOD = 0.25  # [s]
SILENCE = 5.0  # [s] without a status from the flight, after which the silence is reported
STARTING, ATTEMPTS = 300.0, 5  # [s] for a learner to compile and send its first heartbeat; restarts per learner


class LearnerServer:
    """Runs the learners of one flight on a different machine. Leaving the context ends the learners."""

    def __init__(self, address: Address, fleet: FleetProcess | None = None, trust: tuple[str, ...] = ()) -> None:
        """Join the bus.

        Args:
            address: Address of the flight.
            fleet: Process that learns for several flights; None to start separate processes for this flight.
            trust: Python names that the flight may use, e.g. ``mine:task``; this machine imports these names.

        Raises:
            ConfigError: The bus cannot be joined.
        """
        self._network = address.join(NETWORK_SIZES, listen=False, writes=INPUT_TOPICS)
        self._place = tempfile.TemporaryDirectory(prefix="retrim-ground-")
        self.folder = Path(self._place.name)
        self.address, self._fleet, self._trust = address, fleet, trust
        self.processes, self.restarts = dict[str, Popen[bytes] | FleetSlot](), dict[str, int]()
        self._mission: LearnerMission | None = None
        self._distrust: float | None = None
        self._bus: SharedMemoryBus | None = None
        self._bridge: Bridge | None = None
        self.has_traffic = False
        """Whether the last step transferred a message; if not, the caller may sleep."""
        self._version, self._last_beat, self._standing = 0, float("-inf"), "waiting for a flight"
        self._last_note = (0, time.monotonic())

    def __enter__(self) -> "LearnerServer":
        """Return the ground station."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the learners and leave the bus."""
        try:
            self._end()
        finally:
            self._network.close()
            self._place.cleanup()

    def wait(self) -> Iterator[str]:
        """Yield the status until there is a flight to learn for.

        Raises:
            ConfigError: The other machine has a different key or no key.
        """
        while not self._look():
            if (fault := self._network.fault) and self._distrust is None:
                self._distrust = time.monotonic()
            if fault and self._distrust is not None and time.monotonic() > self._distrust + DISTRUST:
                raise ConfigError(f"{self.address}: {fault}")
            yield self._standing

    def learn(self) -> Iterator[str]:
        """Learn until the flight is over; yield the status after each step.

        A silent flight may send messages again, and a different flight may begin.
        """
        while True:
            self._look()
            assert self._bridge is not None
            assert self._bus is not None
            self.has_traffic = self._bridge.step() > 0
            if time.monotonic() - self._last_beat > HEARTBEAT_PERIOD:
                self._last_beat = time.monotonic()
                self._standing = self._beat()
            if end_note := last_note(self._bus, "ended"):
                self._tell(over=True)
                time.sleep(FAREWELL)  # the flight keeps its bridge until it receives this note
                yield one_line(f"flight over: {end_note.get('reason', '')}")
                return
            yield self._standing

    def _look(self) -> bool:
        """Accept a new mission if one has arrived; return whether this station has a mission."""
        message = self._network.latest("mission", self._version)
        try:
            mission = None if message is None else LearnerMission.unpack(message.data)
        except MessageError:
            mission = None
        self._version = self._version if message is None else message.version
        if mission is None:
            return self._mission is not None
        try:
            mission.check(self._trust)
        except RetrimError as error:
            self._standing = f"a flight was refused: {error}"
            note = pack_note("ground", base=mission.base, alive={}, failed=f"the ground refused: {error}", over=False)
            self._network.publish("ground", note)
            return self._mission is not None
        (self.folder / f"start-{mission.number}.safetensors").write_bytes(mission.start)
        before = self._mission
        if before is None or mission.base != before.base:
            self._begin(mission)
        elif mission.number > before.number:
            self._mission = mission
            self.processes["policy"].kill()
            self.processes["policy"].wait()
            self._begin_with("policy")
        return True

    def _begin(self, mission: LearnerMission) -> None:
        """Start learning for a new flight."""
        self._end()
        self._bus = SharedMemoryBus.create({**mission.capacities, **{beat_topic(x): 1024 for x in mission.layers}})
        topics = mission.capacities  # a controller without a residual has no topic for residual parameters
        out, into = (
            [topic for topic in carried_topics if topic in topics] for carried_topics in (OUTPUT_TOPICS, INPUT_TOPICS)
        )
        # The network still holds messages from the previous flight; its ticks, orders and reference do not apply here.
        before = {} if self._bridge is None else self._bridge.versions
        versions = {topic: before.get(topic, 0) for topic in out}
        self._bridge = Bridge(self._network, self._bus, out=out, into=into, versions=versions)
        self._mission, self.restarts = mission, {}
        self._pulses = Pulses(self._bus)
        for layer in mission.layers:
            self._begin_with(layer)

    def _end(self) -> None:
        """End the learners of the current flight."""
        for process in self.processes.values():
            process.kill()
            process.wait()
        self.processes = {}
        if self._bus is not None:
            self._bus.remove()
            self._bus = None

    def _begin_with(self, layer: Any) -> None:
        self._start(layer)
        if self._fleet is None:  # a process that learns for several flights does not send heartbeats for each flight
            self._pulses.expect(layer, STARTING)

    def _start(self, layer: Any) -> None:
        m = self._mission
        assert m is not None
        assert self._bus is not None
        start = self.folder / f"start-{m.number}.safetensors"
        plan = LearnerPlan(
            self._bus.folder, layer, start, m.reference, m.seed, m.base, os.getpid(), m.floor, self._trust
        )
        if (old := self.processes.get(layer)) is not None:
            old.kill()  # a slot in a fleet process remains after that process has died
        complaints = self.folder / f"{layer}.log"
        if self._fleet is not None:
            self.processes[layer] = self._fleet.start(layer, plan, complaints)
        else:
            self.processes[layer] = launch(ROLES[layer].main, plan, complaints)

    def _beat(self) -> str:
        """Report to the flight which learners are alive, restart dead ones, and return the status."""
        assert self._mission is not None
        failure = ""
        for layer in self._pulses.hanging([each for each in self.processes if self.processes[each].poll() is None]):
            self.processes[layer].kill()
            self.processes[layer].wait()
        for layer, process in self.processes.items():
            if process.poll() in (None, 0):
                continue
            if self.restarts.get(layer, 0) < ATTEMPTS:
                self.restarts[layer] = self.restarts.get(layer, 0) + 1
                self._begin_with(layer)
            else:
                failure = f"the {layer} learner on the ground died: {last_words(self.folder / f'{layer}.log')}"
        self._tell(failure)
        return failure or self._stands()

    def _tell(self, failure: str = "", *, over: bool = False) -> None:
        """Report to the flight which learners are alive and whether this station knows that the flight is over."""
        assert self._mission is not None
        alive = {layer: process.poll() is None for layer, process in self.processes.items()}
        note = pack_note("ground", base=self._mission.base, alive=alive, failed=failure, over=over)
        self._network.publish("ground", note)

    def _stands(self) -> str:
        assert self._bus is not None
        if (silent := self._silence()) > SILENCE:
            return f"no word of the flight for {silent:.0f} s"
        if not all(last_note(self._bus, f"ready.{layer}", "ready") for layer in self.processes):
            return "compiling; the flight waits"
        done = {layer: last_note(self._bus, f"learner.{layer}").get("learnt", 0) for layer in self.processes}
        refusals = f"; messages refused: {n}" if (n := self._network.refusals) else ""
        return "learnt: " + ", ".join(f"{layer} {n}" for layer, n in done.items()) + refusals

    def _silence(self) -> float:
        message = None if self._bus is None else self._bus.latest("status")
        version = 0 if message is None else message.version
        if version != self._last_note[0] or not version:
            self._last_note = version, time.monotonic()
        return time.monotonic() - self._last_note[1]


def learn_for(
    addresses: Sequence[Address],
    stop: threading.Event,
    report: Callable[[str], None] = lambda text: None,
    trust: tuple[str, ...] = (),
) -> str:
    """Learn for flights on other machines until all of them are over.

    For a single flight, each layer learns in its own process. Several flights share one process, which runs the updates
    that are due at the same time together.

    Args:
        addresses: Addresses of the flights.
        stop: Event that ends learning early; the flights continue with their last policies.
        report: Function that is called at a high rate with the status of the flights.
        trust: Python names that a flight may use, e.g. ``mine:task``; this machine imports these names.

    Returns:
        The final status of the flights.

    Raises:
        ConfigError: A bus cannot be joined, an address occurs twice, the addresses name more than one rosmaster, or
            an address is outside this machine and there is no shared key.
        Exception: The first failure, raised when the other flights are over.
    """
    if twice := [str(each) for i, each in enumerate(addresses) if each in addresses[:i]]:
        raise ConfigError(f"address {twice[0]} is listed twice; each vehicle needs its own address or key")
    if len({(each.host, each.port) for each in addresses if each.kind == "ros"}) > 1:
        raise ConfigError("vehicles at several rosmasters: a process of ROS 1 has one; give them names at one master")
    for each in addresses:
        each.check_shared()
    with ExitStack() as stack:
        fleet = None
        if len(addresses) > 1:
            fleet = FleetProcess(Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="retrim-fleet-"))))
            stack.callback(fleet.close)
        grounds = [stack.enter_context(LearnerServer(address, fleet, trust)) for address in addresses]
        stands = dict.fromkeys(grounds, "waiting for a flight")
        # One thread per flight, so a slow network to one vehicle does not delay the others.
        pool = stack.enter_context(ThreadPoolExecutor(len(grounds)))
        flights = {pool.submit(_serve, ground, stands, stop): ground for ground in grounds}
        try:
            while (now := wait(flights, REPORT_PERIOD)).not_done:
                for flight in now.done:  # report a failure immediately, since the other flights may last long
                    if (error := flight.exception()) is not None:
                        stands[flights[flight]] = f"failed: {error!r}"
                report(_summary(stands))
        except BaseException:
            stop.set()  # end the threads, too
            raise
        for flight in flights:
            flight.result()
        return _summary(stands)


def _serve(ground: LearnerServer, stands: dict[LearnerServer, str], stop: threading.Event) -> None:
    """Learn for one flight until it is over, and store its status in ``stands``."""
    for words in ground.wait():
        stands[ground] = words
        if stop.wait(IDLE_BEFORE_FLIGHT):
            return
    for words in ground.learn():
        stands[ground] = words
        if stop.is_set():
            return
        if not ground.has_traffic:
            time.sleep(IDLE)


def _summary(stands: dict[LearnerServer, str]) -> str:
    """Return the status of all flights; several flights are labelled with their addresses."""
    if len(stands) == 1:
        return next(iter(stands.values()))
    return "; ".join(f"{ground.address}: {words}" for ground, words in stands.items())
