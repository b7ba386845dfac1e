"""Learners on another machine than the one that flies: a ground station."""

import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from subprocess import Popen
from typing import Any

from ..errors import MessageError
from ..onboard.launch import last_words, launch
from ..onboard.messages import last_note, pack_note
from ..onboard.topics import INTO, MOST, OUT
from ..transport.bridge import Bridge
from ..transport.remote import Address
from ..transport.shared_memory import SharedMemoryBus
from .learner_process import LearnerPlan
from .mission import Mission
from .spec import MAINS

IDLE = 0.002  # [s]
BEAT_EVERY = 0.25  # [s]
SILENCE = 5.0  # [s] without a word of the flight, after which it is told
ATTEMPTS = 5  # to bring a learner back


class Ground:
    """The learners of one flight, which is elsewhere. Leaving it as a context ends them."""

    def __init__(self, address: Address) -> None:
        """Join the bus.

        Raises:
            ConfigError: It cannot be joined.
        """
        self._network = address.join(dict.fromkeys((*OUT, *INTO), MOST), listen=False)
        self._place = tempfile.TemporaryDirectory(prefix="retrim-ground-")
        self.folder = Path(self._place.name)
        self.processes: dict[str, Popen[bytes]] = {}
        self.restarts: dict[str, int] = {}
        self._mission: Mission | None = None
        self._bus: SharedMemoryBus | None = None
        self._bridge: Bridge | None = None
        self._known, self._beaten, self._standing = 0, float("-inf"), "waiting for a flight"
        self._heard = (0, time.monotonic())

    def __enter__(self) -> "Ground":
        """Return the ground station."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the learners and leave the bus."""
        try:
            self._end()
        finally:
            self._network.close()
            self._place.cleanup()

    def wait(self) -> Iterator[None]:
        """Yield until there is a flight to learn for."""
        while not self._look():
            yield
            time.sleep(0.05)

    def learn(self) -> Iterator[str]:
        """Learn until the flight is over; yield how it stands, very often.

        A flight that is not heard of any more may come back, and another one may begin.
        """
        while True:
            self._look()
            assert self._bridge is not None
            assert self._bus is not None
            if not self._bridge.step():
                time.sleep(IDLE)
            if time.monotonic() - self._beaten > BEAT_EVERY:
                self._beaten = time.monotonic()
                self._standing = self._beat()
            if ended := last_note(self._bus, "ended"):
                yield f"flight over: {ended.get('reason', '')}"
                return
            yield self._standing

    def _look(self) -> bool:
        """Take a new mission, if there is one; return whether there is any."""
        message = self._network.latest("mission", self._known)
        if message is None:
            return self._mission is not None
        self._known = message.version
        try:
            mission = Mission.unpack(message.data)
        except MessageError:
            return self._mission is not None
        (self.folder / f"start-{mission.number}.safetensors").write_bytes(mission.start)
        before = self._mission
        if before is None or mission.base != before.base:
            self._begin(mission)
        elif mission.number > before.number:
            self._mission = mission
            self.processes["policy"].kill()
            self.processes["policy"].wait()
            self._start("policy")
        return True

    def _begin(self, mission: Mission) -> None:
        """Learn for a flight that is new."""
        self._end()
        self._bus = SharedMemoryBus.create(mission.capacities)
        topics = mission.capacities  # a controller without a fitted half has no topic for it
        out, into = ([topic for topic in carried if topic in topics] for carried in (OUT, INTO))
        self._bridge = Bridge(self._network, self._bus, out=out, into=into)
        self._mission, self.restarts = mission, {}
        for layer in mission.layers:
            self._start(layer)

    def _end(self) -> None:
        """End the learners of a flight."""
        for process in self.processes.values():
            process.kill()
            process.wait()
        self.processes = {}
        if self._bus is not None:
            self._bus.remove()
            self._bus = None

    def _start(self, layer: Any) -> None:
        m = self._mission
        assert m is not None
        assert self._bus is not None
        start = self.folder / f"start-{m.number}.safetensors"
        plan = LearnerPlan(self._bus.folder, layer, start, m.reference, m.seed, m.base, os.getpid(), m.floor)
        self.processes[layer] = launch(MAINS[layer], plan, self.folder / f"{layer}.log")

    def _beat(self) -> str:
        """Tell the flight who is alive, bring back who is not, and return how it stands."""
        assert self._mission is not None
        failed = ""
        for layer, process in self.processes.items():
            if process.poll() in (None, 0):
                continue
            if self.restarts.get(layer, 0) < ATTEMPTS:
                self.restarts[layer] = self.restarts.get(layer, 0) + 1
                self._start(layer)
            else:
                failed = f"the {layer} learner on the ground died: {last_words(self.folder / f'{layer}.log')}"
        alive = {layer: process.poll() is None for layer, process in self.processes.items()}
        note = pack_note("ground", base=self._mission.base, alive=alive, failed=failed)
        self._network.publish("ground", note)
        return failed or self._stands()

    def _stands(self) -> str:
        assert self._bus is not None
        if (silent := self._silence()) > SILENCE:
            return f"no word of the flight for {silent:.0f} s"
        if not all(last_note(self._bus, f"ready.{layer}", "ready") for layer in self.processes):
            return "compiling; the flight waits"
        done = {layer: last_note(self._bus, f"learner.{layer}").get("learnt", 0) for layer in self.processes}
        return "learnt: " + ", ".join(f"{layer} {n}" for layer, n in done.items())

    def _silence(self) -> float:
        message = None if self._bus is None else self._bus.latest("status")
        version = 0 if message is None else message.version
        if version != self._heard[0] or not version:
            self._heard = version, time.monotonic()
        return time.monotonic() - self._heard[1]
