"""Processes of drills: a minimal plant, minimal learners, writers, and a local bus that replaces a network.

The processes do not import JAX, so that twenty flights take little time.
"""

import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from retrim.onboard.commands import wait_for_take_off
from retrim.onboard.guard import UP, G
from retrim.onboard.heartbeat import Heart
from retrim.onboard.messages import Parameters, Sample, Setpoint, pack_note
from retrim.onboard.realtime import ParentWatch, be_punctual, sleep_until
from retrim.onboard.topics import OUTPUT_TOPICS
from retrim.transport.remote import Address
from retrim.transport.shared_memory import SharedMemoryBus

DT = 0.02
HOME = np.array([0.0, 0.0, 1.0])
PAGE_TOPICS = ("sample", "status", "setpoint", "fallback", "knobs", "wish", "followed", "ended", "world",
               "learner.residual", "learner.policy", "ready.page", "refusals.page")  # fmt: skip


def level(p=HOME, *, x=0.0) -> np.ndarray:
    return np.concatenate([np.asarray(p) + np.array([x, 0.0, 0.0]), np.eye(3).ravel(), np.zeros(3)])


def rotation(vector):
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle if angle else np.zeros(3)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def move(x, u, push=(0.0, 0.0, 0.0)):
    """Return the state of a point mass after one tick, in steps of 1 ms."""
    p, R, v = x[:3].copy(), x[3:12].reshape(3, 3).copy(), x[12:].copy()
    turn = rotation(1e-3 * np.asarray(u[1:]))
    for _ in range(20):
        a = u[0] * R[:, 2] - G * UP + np.asarray(push)
        p, v, R = p + 1e-3 * v, v + 1e-3 * a, R @ turn
    return np.concatenate([p, R.ravel(), v])


@dataclass(frozen=True)
class DrillPlan:
    """Arguments of a process of a drill."""

    folder: Path
    parent: int
    role: str
    x0: np.ndarray
    base: str


def plant(plan: DrillPlan) -> None:
    """Run a point mass with a delay of one tick, in real time."""
    bus, parent = SharedMemoryBus(plan.folder), ParentWatch(plan.parent)
    bus.publish("ready.plant", pack_note("ready", refused=be_punctual(20, {0})))
    if (epoch := wait_for_take_off(bus, parent)) is None:
        return
    x, tick, acting = plan.x0, 0, np.array([G, 0.0, 0.0, 0.0])
    accepted_command = acting
    while True:
        sleep_until(epoch + tick * DT)
        bus.publish("sample", Sample(tick, tick * DT, time.monotonic(), 0.0, x, x, accepted_command).pack())
        while time.monotonic() < epoch + (tick + 0.6) * DT:
            result = [Setpoint.unpack(m.data) for m in map(bus.latest, ("setpoint", "fallback")) if m is not None]
            now = [each for each in result if each.tick == tick or each.is_final]
            if now:
                accepted_command = now[0].u
                if now[0].is_final:
                    bus.publish("ended", pack_note("ended", reason=now[0].ending(x[2])))
                    return
                break
            time.sleep(5e-4)
        x, acting, tick = move(x, acting), accepted_command, tick + 1


def learner(plan: DrillPlan) -> None:
    """Publish gains near the current ones, at intervals."""
    bus, parent = SharedMemoryBus(plan.folder), ParentWatch(plan.parent)
    bus.publish(f"ready.{plan.role}", pack_note("ready", base=plan.base))
    topic, rng, heart = "parameters.policy", np.random.default_rng(), Heart(bus, plan.role)
    while not parent.has_ended(0.1) and bus.latest("ended") is None:
        heart.beat()
        before = bus.latest(topic)
        version = 1 if before is None else before.version + 1
        gains = np.array([4.0, 3.5]) + 0.1 * rng.normal(size=2)
        if plan.role == "policy":
            bus.publish(topic, Parameters("policy", version, plan.base, 0.0, {"gains": gains}).pack())


def nothing(plan) -> None:
    """Run for a long time without doing anything."""
    time.sleep(60.0)


def write_for_ever(folder: Path, topic: str, room: int) -> None:
    """Write messages of many lengths without end; each message repeats one byte."""
    bus = SharedMemoryBus(folder)
    i = 0
    while True:
        i += 1
        bus.publish(topic, (i % 256).to_bytes(1, "little") * (1 + 7919 * i % room))


def answer(address: Address, topics: dict[str, int], topic: str, data: bytes) -> None:
    """Publish one message after a message of the other end has arrived."""
    bus = address.join(topics, listen=False)
    until = time.monotonic() + 10.0
    while bus.latest(topic) is None and time.monotonic() < until:
        time.sleep(0.01)
    bus.publish(topic, data)
    time.sleep(2.0)
    os._exit(0)


class NetworkStandIn(SharedMemoryBus):
    """A local bus that replaces a network and records that a process left it."""

    def close(self):
        if self._maps:
            (self.folder.parent / f"{self.folder.name}-left").touch()
        super().close()


@dataclass(frozen=True)
class LocalAddress(Address):
    """An address of a local bus that replaces a network."""

    folder: Path = Path()

    def join(self, capacities, *, listen, writes=()):
        assert listen
        assert set(writes) == set(OUTPUT_TOPICS)
        return NetworkStandIn(self.folder)
