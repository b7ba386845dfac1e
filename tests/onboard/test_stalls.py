"""Stalls of the whole machine are not attributed to the flight processes."""

import pytest

from retrim.onboard.messages import unpack_note
from retrim.onboard.stalls import MEMORY, STALL, Stalls, count_lost_ticks

EVERY = 0.002


def test_only_very_late_wake_ups_are_stalls():
    stalls, now = Stalls(EVERY), 5.0
    for pause in (0.0, EVERY, EVERY + 0.9 * STALL, EVERY + 0.045, EVERY, EVERY + 0.010):
        now += pause
        stalls.woke(now)
    assert stalls.count == 2
    assert stalls.longest == pytest.approx(0.045)
    text = unpack_note(stalls.pack(), "stalls")
    assert text["count"] == 2
    assert [end - begin for begin, end in text["newest"]] == pytest.approx([0.047, 0.012])


def test_newest_stalls_are_kept_and_note_fits():
    stalls = Stalls(EVERY)
    for k in range(3 * MEMORY):
        stalls.woke(1e6 + 0.0123456789 * k)
    assert stalls.count == 3 * MEMORY - 1
    assert len(stalls.newest) == MEMORY
    assert stalls.newest[-1][1] == pytest.approx(1e6 + 0.0123456789 * (3 * MEMORY - 1))
    assert len(stalls.pack()) < 16384


def test_gap_counts_once_for_overlapping_stalls():
    gaps = [(1.00, 1.04, 1), (2.00, 2.10, 4)]
    assert count_lost_ticks([], gaps, 0.02) == 0
    assert count_lost_ticks([(1.01, 1.02), (1.02, 1.05)], gaps, 0.02) == 1
    assert count_lost_ticks([(0.5, 3.0)], gaps, 0.02) == 5
    assert count_lost_ticks([(1.04, 1.97)], gaps, 0.02) == 0
    assert count_lost_ticks([(1.04, 1.99)], gaps, 0.02) == 4  # the plant catches up
