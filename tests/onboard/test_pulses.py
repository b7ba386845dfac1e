"""A process that is alive and silent hangs; one that starts, computes, or sleeps with the whole machine does not."""

import time

import pytest

from retrim.onboard.heartbeat import PERIOD, Heart, Pacemaker
from retrim.onboard.messages import last_note
from retrim.onboard.pulses import LOOK, SILENCE, Pulses
from retrim.transport.in_process import InProcessBus


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def bus():
    return InProcessBus({"beat.recorder": 1024, "beat.policy": 1024, "sample": 4096, "setpoint": 4096})


def time_of_hang(pulses, clock, role, beat=lambda: None, until=10.0, step=0.05):
    """Return the time after which a role is found to hang."""
    while clock.now < until:
        clock.now += step
        beat()
        if pulses.hanging([role]):
            return clock.now
    return None


@pytest.mark.parametrize("role", ["recorder", "plant", "control"])
def test_silence_of_two_seconds_is_a_hang(bus, role):
    clock = Clock()
    pulses, topic = Pulses(bus, clock), {"plant": "sample", "control": "setpoint"}.get(role, f"beat.{role}")
    pulses.expect(role)
    assert time_of_hang(pulses, clock, role, lambda: bus.publish(topic, b"x")) is None
    assert time_of_hang(pulses, clock, role, until=20.0) == pytest.approx(10.0 + SILENCE, abs=0.11)


def test_unexpected_or_dead_processes_are_ignored(bus):
    clock = Clock()
    pulses = Pulses(bus, clock)
    assert time_of_hang(pulses, clock, "recorder") is None
    pulses.expect("recorder")
    clock.now += 10.0
    assert pulses.hanging([]) == []


def test_starting_process_has_limited_time_until_first_heartbeat(bus):
    clock = Clock()
    pulses = Pulses(bus, clock)
    bus.publish("beat.policy", b"of the process before it")
    pulses.expect("policy", within=60.0)
    assert time_of_hang(pulses, clock, "policy", until=50.0) is None
    bus.publish("beat.policy", b"x")
    assert time_of_hang(pulses, clock, "policy", until=60.0) == pytest.approx(50.0 + SILENCE, abs=0.2)


def test_suspended_machine_is_not_silence(bus):
    clock = Clock()
    pulses = Pulses(bus, clock)
    pulses.expect("recorder")
    for _ in range(int(SILENCE / LOOK) - 1):
        clock.now += 100.0
        assert pulses.hanging(["recorder"]) == []


def test_heartbeat_is_sent_by_loop_at_ten_hertz(bus):
    clock = Clock()
    heart = Heart(bus, "recorder", clock)
    for _ in range(1000):
        clock.now += 0.002
        heart.beat()
    assert last_note(bus, "beat.recorder")["count"] == pytest.approx(2.0 / PERIOD, abs=1)
    Heart(bus, "watchdog", clock).beat()  # a bus without its topic


def test_thread_sends_no_heartbeat_for_late_loop(bus):
    clock = Clock()
    pacemaker = Pacemaker(bus, "policy", clock)
    pacemaker.touch(30.0)
    for _ in range(400):
        clock.now += 0.1
        pacemaker.beat()
    assert last_note(bus, "beat.policy")["count"] == pytest.approx(300, abs=2)
    pacemaker.touch(5.0)
    pacemaker.beat()
    assert last_note(bus, "beat.policy")["count"] == pytest.approx(301, abs=2)


def test_pacemaker_sends_heartbeats_during_computation(bus):
    with Pacemaker(bus, "policy") as pacemaker:
        pacemaker.touch(60.0)
        until = time.monotonic() + 20.0
        while last_note(bus, "beat.policy").get("count", 0) < 3 and time.monotonic() < until:
            time.sleep(0.01)
    assert last_note(bus, "beat.policy")["count"] >= 3
