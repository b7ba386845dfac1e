"""Estimates of the clock of a different machine."""

import numpy as np
import pytest

from retrim.plants.bridges.clock import RemoteClock, StampClock


def ask(clock, remote_of, times, *, there=1e-4, back=1e-4):
    for t in times:
        clock.record_exchange(t, remote_of(t + there), t + there + back)


def test_offset_is_unknown_before_first_exchange():
    assert RemoteClock().here(1.0) is None


@pytest.mark.parametrize("rate", [0.5, 0.99, 1.0, 2.0])
def test_offset_and_rate_are_estimated(rate):
    clock = RemoteClock()
    ask(clock, lambda t: 77.0 + rate * t, 0.1 * np.arange(10))
    assert clock.here(77.0 + rate * 1.5) == pytest.approx(1.5, abs=2e-4)


def test_error_is_at_most_half_the_round_trip():
    clock, rng = RemoteClock(), np.random.default_rng(0)
    for k in range(40):
        t, there, back = 0.1 * k, *rng.uniform(1e-4, 2e-3, 2)
        clock.record_exchange(t, 5.0 + 0.99 * (t + there), t + there + back)
        if k > 5:
            assert clock.here(5.0 + 0.99 * t) == pytest.approx(t, abs=2e-3)


def test_slow_exchange_has_little_weight():
    clock = RemoteClock()
    ask(clock, lambda t: t, 0.1 * np.arange(8))
    clock.record_exchange(0.8, 0.8, 1.0)  # the answer was late by 0.2 s
    assert clock.here(1.0) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("slip", [-4.0, 0.02, 4.0])
def test_clock_jump_is_followed_immediately(slip):
    clock = RemoteClock()
    ask(clock, lambda t: t, 0.1 * np.arange(10))
    ask(clock, lambda t: t + slip, [1.0])
    assert clock.here(1.0 + slip) == pytest.approx(1.0, abs=1e-3)


def arrive(clock, stamps, times):
    return [clock.here(stamp, now) for stamp, now in zip(stamps, times, strict=True)]


def test_fastest_message_determines_offset():
    clock, times = StampClock(), 100.0 + 0.02 * np.arange(50)
    late = np.random.default_rng(1).uniform(0.0, 0.01, 50)
    late[0] = 0.0
    np.testing.assert_allclose(arrive(clock, times - 90.0, times + late), times)
    assert clock.jumps == 0


def test_reordered_and_duplicate_messages_are_recognised():
    clock = StampClock()
    stamps = 0.01 * np.array([1, 3, 2, 3, 3, 3, 5, 4, 7, 6])
    result = [each is not None for each in arrive(clock, stamps, 50.0 + 0.01 * np.arange(10))]
    assert result == [True, True, False, False, False, False, True, False, True, False]
    assert clock.jumps == 0


@pytest.mark.parametrize("jump", [-1e6, -1.0, -0.05, 0.6, 1e6])
def test_adjusted_clock_is_followed(jump):
    clock, times = StampClock(), 2e6 + 0.01 * np.arange(30)
    stamps = times + np.where(np.arange(30) < 10, 0.0, jump)
    result = arrive(clock, stamps, times)
    assert [k for k, each in enumerate(result) if each is None] == ([10, 11] if jump < 0.0 else [])
    np.testing.assert_allclose(result[:10] + result[12:], np.delete(times, [10, 11]), atol=1e-6)
    assert clock.jumps == 1


def test_single_future_stamp_has_no_lasting_effect():
    clock, times = StampClock(), 500.0 + 0.01 * np.arange(30)
    stamps = times.copy()
    stamps[10] += 1e9
    result = arrive(clock, stamps, times)
    assert [k for k, each in enumerate(result) if each is None] == [11, 12]
    np.testing.assert_allclose(result[13:], times[13:])


def test_message_age_is_not_negative():
    clock, rng = StampClock(), np.random.default_rng(2)
    now = 10.0
    for _ in range(300):
        now += rng.uniform(0.0, 0.03)
        here = clock.here(now + rng.normal(0.0, 0.5), now)
        assert here is None or here <= now


@pytest.mark.parametrize("stamp", [0.0, -1.0, float("nan")])
def test_missing_stamp_is_replaced_by_arrival_time(stamp):
    assert StampClock().here(stamp, 7.0) == 7.0
