"""Another machine's clock, as ours tells it."""

import numpy as np
import pytest

from retrim.plants.bridges.clock import RemoteClock


def ask(clock, remote_of, times, *, there=1e-4, back=1e-4):
    for t in times:
        clock.record_exchange(t, remote_of(t + there), t + there + back)


def test_nobody_asked_nobody_knows():
    assert RemoteClock().here(1.0) is None


@pytest.mark.parametrize("rate", [0.5, 0.99, 1.0, 2.0])
def test_offset_and_rate_are_found(rate):
    clock = RemoteClock()
    ask(clock, lambda t: 77.0 + rate * t, 0.1 * np.arange(10))
    assert clock.here(77.0 + rate * 1.5) == pytest.approx(1.5, abs=2e-4)


def test_no_exchange_is_wrong_by_more_than_half_its_round_trip():
    clock, rng = RemoteClock(), np.random.default_rng(0)
    for k in range(40):
        t, there, back = 0.1 * k, *rng.uniform(1e-4, 2e-3, 2)
        clock.record_exchange(t, 5.0 + 0.99 * (t + there), t + there + back)
        if k > 5:
            assert clock.here(5.0 + 0.99 * t) == pytest.approx(t, abs=2e-3)


def test_a_slow_exchange_among_fast_ones_says_little():
    clock = RemoteClock()
    ask(clock, lambda t: t, 0.1 * np.arange(8))
    clock.record_exchange(0.8, 0.8, 1.0)  # the answer was late by 0.2 s
    assert clock.here(1.0) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("slip", [-4.0, 0.02, 4.0])
def test_a_clock_that_jumps_is_followed_at_once(slip):
    clock = RemoteClock()
    ask(clock, lambda t: t, 0.1 * np.arange(10))
    ask(clock, lambda t: t + slip, [1.0])
    assert clock.here(1.0 + slip) == pytest.approx(1.0, abs=1e-3)
