"""Determines the times of the messages in a bag, on one clock; message stamps are used if they exist."""

from collections.abc import Mapping
from operator import attrgetter
from typing import Any

import numpy as np

from .series import Clock

MICROSECOND, NANOSECOND = 1e-6, 1e-9
CLOCK_DIFFERENCE = 1.0  # difference above which two clocks are different [s]
LEAST_MESSAGES = 50  # for an estimate of delays
NEIGHBOURHOOD = 0.5  # [s], time around a message from which its delay is estimated
EVEN = 3.0  # [periods], largest spread of delays at an even rate
LOST = 0.5  # [periods], largest spread of the shortest delays without a lost message
EARLY_PERCENTILE = 5.0  # percentile of delays that counts as the delay of a message that did not wait


def stamp_of(message: Any, time: Clock | None) -> float:
    """Return the message's own time [s] from the map's field, the header or the PX4 stamps.

    Zero is an unset stamp or the beginning of a simulation; NaN means that the message has no stamp.
    """
    result = float("nan")
    stamps = [] if time is None else [(time.field, time.scale)]
    stamps += [("header.stamp", NANOSECOND), ("stamp", NANOSECOND)]
    if str(getattr(message, "__msgtype__", "")).startswith("px4_msgs/"):
        stamps += [("timestamp_sample", MICROSECOND), ("timestamp", MICROSECOND)]
    for field, scale in stamps:
        try:
            value = attrgetter(field)(message)
        except AttributeError:
            continue
        if hasattr(value, "sec"):
            value, scale = value.sec * 10**9 + value.nanosec, NANOSECOND
        if isinstance(value, (int, float, np.number)):
            result = scale * float(value)
        if result > 0.0:
            break
    return result


def on_one_time(stamps: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return each topic's times on one clock, and notes.

    For a topic whose messages have no stamps, the times of reception are used. Other topics may have stamps from a
    different clock, for example an autopilot's uptime. All stamps are then shifted to the recorder's clock, by
    the delay of each topic's messages that did not wait.

    Args:
        stamps: Stamp (NaN if absent) and time of reception of each message [s], (n, 2), by topic.
    """
    times, notes, ahead = dict[str, np.ndarray](), list[str](), dict[str, float]()
    for topic, both in stamps.items():
        stamp, arrival = both.T
        if np.mean(np.isnan(stamp) | (stamp == 0.0)) > 0.5:
            times[topic], even = evenly(arrival)
            remark = ", without the delays of single messages" if even else ""
            notes.append(f"{topic} has no stamps; its times are those of reception{remark}")
        else:
            times[topic] = stamp
            ahead[topic] = float(np.nanpercentile(arrival - stamp, EARLY_PERCENTILE))
    alike = not ahead or max(ahead.values()) - min(ahead.values()) < CLOCK_DIFFERENCE
    if len(ahead) < len(times):
        alike = alike and all(abs(shift) < CLOCK_DIFFERENCE for shift in ahead.values())
    if not alike:
        for topic, shift in ahead.items():
            times[topic] = times[topic] + shift
        notes.append("topics have clocks of their own, and are brought to that of the recorder")
    return times, notes


def evenly(arrival: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the send times (plus the shortest delay) of messages with an even rate, and whether the rate is even.

    A message may be late but never early. The neighbour with the shortest delay therefore determines the send times of
    the messages around it. If the rate is not even, or if messages are lost, the times of reception are returned.
    """
    n = len(arrival)
    if n < LEAST_MESSAGES:
        return arrival, False
    turn = np.arange(n)
    slope, start = np.polyfit(turn, arrival - arrival[0], 1)
    late = arrival - arrival[0] - start - slope * turn
    reach = max(1, round(NEIGHBOURHOOD / slope)) if slope > 0.0 else n
    if reach >= n or np.ptp(late) > EVEN * slope:
        return arrival, False
    from scipy.ndimage import minimum_filter1d, uniform_filter1d  # local: they take as long to import as all of retrim

    least = minimum_filter1d(late, 2 * reach + 1, mode="nearest")
    if np.ptp(least) > LOST * slope:
        return arrival, False
    least = uniform_filter1d(least, 2 * reach + 1, mode="nearest")
    return arrival - late + np.minimum(least, late), True
