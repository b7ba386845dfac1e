"""The clock of another machine, as ours tells it."""

from collections import deque

import numpy as np

KEPT = 10  # exchanges
ENOUGH = 3  # of them, to know the rate
APART = 0.03  # [s], standard deviation of their times, to know the rate
SLIP = 3e-3  # [s] beyond what a round trip explains
JITTER = 1e-4  # [s], of the quickest exchange
WINDOW_S = 2.0  # [s] within which some message has come without a delay


class RemoteClock:
    """Follows the offset and the rate of a clock that is asked again and again: a simulated one does not keep time.

    An exchange counts by the inverse square of its round trip, which bounds its error.
    """

    def __init__(self) -> None:
        self._exchanges: deque[tuple[float, float, float]] = deque(maxlen=KEPT)
        self._line: tuple[float, float] | None = None
        self._rate = 1.0

    def exchanged(self, asked: float, remote: float, answered: float) -> None:
        """Take note of one exchange.

        Args:
            asked: When the other clock was asked, by ours [s].
            remote: What it said [s].
            answered: When its answer came, by ours [s].
        """
        known = self.here(remote) if len(self._exchanges) >= ENOUGH else None
        slipped = known is not None and abs(0.5 * (asked + answered) - known) > 0.5 * (answered - asked) + SLIP
        if slipped or (self._exchanges and remote < self._exchanges[-1][0]):
            self._exchanges.clear()  # the other machine stood still, or has started again
        self._exchanges.append((remote, 0.5 * (asked + answered), answered - asked))
        x, y, trips = np.array(self._exchanges).T
        weights = (trips + JITTER) ** -2
        weights /= weights.sum()
        centre, height = float(weights @ x), float(weights @ y)
        spread = float(weights @ (x - centre) ** 2)
        if len(x) >= ENOUGH and spread > APART**2:
            self._rate = float(np.clip(weights @ ((x - centre) * (y - height)) / spread, 0.2, 5.0))
        self._line = centre, height

    def here(self, remote: float) -> float | None:
        """Return what our clock shows when the other shows ``remote`` [s]; None if it was never asked."""
        if self._line is None:
            return None
        centre, height = self._line
        return height + self._rate * (remote - centre)


class ArrivalClock:
    """Follows a clock that nobody can ask, by when its messages arrive: the quickest of the last ones count.

    How long even they took is not known to it.
    """

    def __init__(self) -> None:
        self._arrived: deque[tuple[float, float]] = deque()

    def arrived(self, remote: float, now: float) -> None:
        """Take note of a message, of a time of the other clock, that came at one of ours [s]."""
        while self._arrived and now - self._arrived[0][0] > WINDOW_S:
            self._arrived.popleft()
        self._arrived.append((now, now - remote))

    def here(self, remote: float) -> float | None:
        """Return what our clock shows when the other shows ``remote`` [s]; None if it was never heard."""
        return remote + min(offset for _, offset in self._arrived) if self._arrived else None
