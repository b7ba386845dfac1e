"""Learners on another machine than the one that flies: a ground station."""

import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from subprocess import Popen
from typing import Any

from ..errors import MessageError
from ..onboard.launch import launch
from ..onboard.messages import pack_note, unpack_note
from ..onboard.topics import INTO, MOST, OUT
from ..transport.bridge import Bridge
from ..transport.remote import Address
from ..transport.shared_memory import SharedMemoryBus
from .learner_process import LearnerPlan
from .mission import Mission
from .spec import MAINS

IDLE = 0.002  # [s]
BEAT_EVERY = 0.25  # [s]
SILENCE = 30.0  # [s] without a word of the flight, after which it is over
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
        self._known, self._beaten = 0, float("-inf")
        self._heard = (0, time.monotonic())

    def __enter__(self) -> "Ground":
        """Return the ground station."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the learners and leave the bus."""
        for process in self.processes.values():
            process.kill()
            process.wait()
        if self._mission is not None:
            self._bus.remove()
        self._network.close()
        self._place.cleanup()

    def wait(self) -> Iterator[None]:
        """Yield until there is a flight to learn for."""
        while not self._look():
            yield
            time.sleep(0.05)

    def learn(self) -> Iterator[str]:
        """Learn until the flight is over; yield how it stands, very often."""
        assert self._mission is not None
        topics = self._mission.capacities  # a controller without a fitted half has no topic for it
        out, into = ([topic for topic in carried if topic in topics] for carried in (OUT, INTO))
        bridge = Bridge(self._network, self._bus, out=out, into=into)
        while True:
            self._look()
            if not bridge.step():
                time.sleep(IDLE)
            if time.monotonic() - self._beaten > BEAT_EVERY:
                self._beaten = time.monotonic()
                self._beat()
            if (ended := self._note("ended")) is not None:
                yield f"flight over: {ended.get('reason', '')}"
                return
            if (silent := self._silence()) > SILENCE:
                yield f"no word of the flight for {silent:.0f} s"
                return
            yield self._stands()

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
        before, self._mission = self._mission, mission
        (self.folder / f"start-{mission.number}.safetensors").write_bytes(mission.start)
        if before is None:
            self._bus = SharedMemoryBus.create(mission.capacities)
            for layer in mission.layers:
                self._start(layer)
        elif mission.number > before.number:
            self.processes["policy"].kill()
            self.processes["policy"].wait()
            self._start("policy")
        return True

    def _start(self, layer: Any) -> None:
        m = self._mission
        assert m is not None
        start = self.folder / f"start-{m.number}.safetensors"
        plan = LearnerPlan(self._bus.folder, layer, start, m.reference, m.seed, m.base, os.getpid())
        self.processes[layer] = launch(MAINS[layer], plan, self.folder / f"{layer}.log")

    def _beat(self) -> None:
        """Tell the flight who is alive, and bring back who is not."""
        for layer, process in self.processes.items():
            if process.poll() not in (None, 0) and self.restarts.get(layer, 0) < ATTEMPTS:
                self.restarts[layer] = self.restarts.get(layer, 0) + 1
                self._start(layer)
        alive = {layer: process.poll() is None for layer, process in self.processes.items()}
        self._network.publish("ground", pack_note("ground", alive=alive, restarts=self.restarts))

    def _silence(self) -> float:
        message = self._bus.latest("status")
        version = 0 if message is None else message.version
        if version != self._heard[0] or not version:
            self._heard = version, time.monotonic()
        return time.monotonic() - self._heard[1]

    def _note(self, topic: str) -> dict[str, Any] | None:
        message = self._bus.latest(topic)
        with contextlib.suppress(MessageError):
            return None if message is None else unpack_note(message.data, topic)
        return None

    def _stands(self) -> str:
        done = {layer: (self._note(f"learner.{layer}") or {}).get("learnt", 0) for layer in self.processes}
        ready = all(self._bus.latest(f"ready.{layer}") is not None for layer in self.processes)
        learnt = ", ".join(f"{layer} {n}" for layer, n in done.items())
        return f"learnt: {learnt}" if ready else "compiling; the flight waits"
