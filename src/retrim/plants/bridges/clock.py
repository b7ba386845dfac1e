"""Map a remote machine's clock to this machine's clock."""

import math
from collections import deque

import numpy as np

MEMORY = 10  # exchanges
LEAST_EXCHANGES = 3  # smallest number of exchanges for an estimate of the rate
LEAST_SPREAD = 0.03  # [s], smallest standard deviation of the exchange times for an estimate of the rate
SLIP = 3e-3  # [s], largest deviation in excess of the error bound by the round trip
JITTER = 1e-4  # [s], of the quickest exchange
JUMP_S = 0.5  # [s] by which a clock must be ahead of the arrival times to be a clock that was set
LEAST_STEPS_BACK = 3  # messages in a row with older but rising stamps, after which the clock was set back
WINDOW_S = 2.0  # [s] in which at least one message is assumed to arrive without a delay


class RemoteClock:
    """Estimates the offset and rate of a remote clock from repeated exchanges.

    The rate is estimated because simulated clocks do not run in real time.

    Each exchange is weighted by the inverse square of its round-trip time, which bounds the error of the exchange.
    """

    def __init__(self) -> None:
        self._exchanges: deque[tuple[float, float, float]] = deque(maxlen=MEMORY)
        self._line: tuple[float, float] | None = None
        self._rate = 1.0

    def record_exchange(self, request_time: float, remote: float, answer_time: float) -> None:
        """Record one exchange.

        Args:
            request_time: Time of the request, on our clock [s].
            remote: Time in the answer, on the other clock [s].
            answer_time: Arrival time of the answer, on our clock [s].
        """
        remote_time = self.here(remote) if len(self._exchanges) >= LEAST_EXCHANGES else None
        clock_slips = (
            remote_time is not None
            and abs(0.5 * (request_time + answer_time) - remote_time) > 0.5 * (answer_time - request_time) + SLIP
        )
        if clock_slips or (self._exchanges and remote < self._exchanges[-1][0]):
            self._exchanges.clear()  # the other machine stalled or restarted
        self._exchanges.append((remote, 0.5 * (request_time + answer_time), answer_time - request_time))
        x, y, trips = np.array(self._exchanges).T
        weights = (trips + JITTER) ** -2
        weights /= weights.sum()
        centre, height = float(weights @ x), float(weights @ y)
        spread = float(weights @ (x - centre) ** 2)
        if len(x) >= LEAST_EXCHANGES and spread > LEAST_SPREAD**2:
            self._rate = float(np.clip(weights @ ((x - centre) * (y - height)) / spread, 0.2, 5.0))
        self._line = centre, height

    def here(self, remote: float) -> float | None:
        """Return the time on our clock at time ``remote`` on the other clock [s]; None before the first exchange."""
        if self._line is None:
            return None
        centre, height = self._line
        return height + self._rate * (remote - centre)


class ArrivalClock:
    """Estimates a remote clock's offset from the arrival times of messages, using the quickest recent message.

    The estimate includes the unknown transmission time of that message.
    """

    def __init__(self) -> None:
        self._arrivals: deque[tuple[float, float]] = deque()

    def record_arrival(self, remote: float, now: float) -> None:
        """Record a message with its time on the other clock and its arrival time on our clock [s]."""
        while self._arrivals and now - self._arrivals[0][0] > WINDOW_S:
            self._arrivals.popleft()
        self._arrivals.append((now, now - remote))

    def here(self, remote: float) -> float | None:
        """Return the time on our clock at time ``remote`` on the other clock [s]; None before the first message."""
        return remote + min(offset for _, offset in self._arrivals) if self._arrivals else None


class StampClock:
    """Maps the stamps of messages to our clock.

    Messages that arrive out of order or again are recognised. A clock that is set forward or back, for example because
    its program was restarted, is followed from the next message or the third message on.
    """

    def __init__(self) -> None:
        self._clock = ArrivalClock()
        self._newest, self._last, self._older, self._arrival = -math.inf, -math.inf, 0, -math.inf
        self.jumps = 0
        """Number of times that the clock was set."""

    def here(self, stamp: float, now: float) -> float | None:
        """Return the time on our clock at which a message was valid; None if it is out of order.

        Args:
            stamp: Time in the message, on the other clock [s]; zero or less if the sender does not fill it in, so that
                the arrival time is used.
            now: Time of arrival, on our clock [s].
        """
        if not stamp > 0.0:
            return now
        if stamp <= self._newest:
            if stamp != self._newest:
                self._older = self._older + 1 if stamp > self._last else 1
            self._last = stamp
            if self._older < LEAST_STEPS_BACK:
                return None
            self._restart()
        elif math.isfinite(self._newest) and stamp - self._newest - (now - self._arrival) > JUMP_S:
            self._restart()
        self._newest, self._last, self._older, self._arrival = stamp, stamp, 0, now
        self._clock.record_arrival(stamp, now)
        result = self._clock.here(stamp)
        assert result is not None
        return min(result, now)

    def _restart(self) -> None:
        self._clock = ArrivalClock()
        self.jumps += 1
