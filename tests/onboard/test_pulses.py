"""A process that is alive and silent hangs; one that starts, computes, or sleeps with its whole machine does not."""

import time

import pytest

from retrim.onboard.heartbeat import EVERY, Heart, Pacemaker
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


def silent_after(pulses, clock, role, beat=lambda: None, until=10.0, step=0.05):
    """Return when a role is found to hang."""
    while clock.now < until:
        clock.now += step
        beat()
        if pulses.hanging([role]):
            return clock.now
    return None


@pytest.mark.parametrize("role", ["recorder", "plant", "control"])
def test_who_says_nothing_for_two_seconds_hangs_and_who_beats_does_not(bus, role):
    clock = Clock()
    pulses, topic = Pulses(bus, clock), {"plant": "sample", "control": "setpoint"}.get(role, f"beat.{role}")
    pulses.expect(role)
    assert silent_after(pulses, clock, role, lambda: bus.publish(topic, b"x")) is None
    assert silent_after(pulses, clock, role, until=20.0) == pytest.approx(10.0 + SILENCE, abs=0.11)


def test_who_is_not_expected_or_not_alive_is_not_looked_at(bus):
    clock = Clock()
    pulses = Pulses(bus, clock)
    assert silent_after(pulses, clock, "recorder") is None
    pulses.expect("recorder")
    clock.now += 10.0
    assert pulses.hanging([]) == []


def test_a_process_that_starts_has_its_time_until_the_first_beat_and_no_longer(bus):
    clock = Clock()
    pulses = Pulses(bus, clock)
    bus.publish("beat.policy", b"of the process before it")
    pulses.expect("policy", within=60.0)
    assert silent_after(pulses, clock, "policy", until=50.0) is None
    bus.publish("beat.policy", b"x")
    assert silent_after(pulses, clock, "policy", until=60.0) == pytest.approx(50.0 + SILENCE, abs=0.2)


def test_a_machine_that_stood_still_is_no_silence(bus):
    clock = Clock()
    pulses = Pulses(bus, clock)
    pulses.expect("recorder")
    for _ in range(int(SILENCE / LOOK) - 1):
        clock.now += 100.0
        assert pulses.hanging(["recorder"]) == []


def test_a_heart_beats_ten_times_a_second_and_only_when_its_loop_comes_by(bus):
    clock = Clock()
    heart = Heart(bus, "recorder", clock)
    for _ in range(1000):
        clock.now += 0.002
        heart.beat()
    assert last_note(bus, "beat.recorder")["count"] == pytest.approx(2.0 / EVERY, abs=1)
    Heart(bus, "watchdog", clock).beat()  # a bus without its topic


def test_a_thread_does_not_beat_for_a_loop_that_is_late(bus):
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


def test_a_pacemaker_beats_beside_a_loop_that_computes(bus):
    with Pacemaker(bus, "policy") as pacemaker:
        pacemaker.touch(60.0)
        until = time.monotonic() + 20.0
        while last_note(bus, "beat.policy").get("count", 0) < 3 and time.monotonic() < until:
            time.sleep(0.01)
    assert last_note(bus, "beat.policy")["count"] >= 3
