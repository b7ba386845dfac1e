"""A plant whose clock, commands and ticks are not those of a simulation."""

from retrim.config import Scenario
from retrim.plants import Plant


class OddPlant(Plant):
    """The simple plant with a shifted clock, with limited commands, or with three ticks in one step at ``stalls``."""

    def __init__(self, disturbance="none", *, clock=0.0, limit=None, stalls=(), sensors="ideal"):
        self._inner = Scenario(disturbance, "simple", sensors=sensors).make()
        self._clock, self._limit, self._stalls = clock, limit, stalls
        self.dt = self._inner.dt
        self.commands, self.stops, self._steps = [], 0, 0

    def reset(self, x0):
        self._steps = 0
        return self._shown(self._inner.reset(x0))

    def step(self, u):
        self.commands.append(u)
        if self._limit is not None:
            u = self._limit(u)
        for _ in range(3 if self._steps in self._stalls else 1):
            measurement, _ = self._inner.step(u)
        self._steps += 1
        return self._shown(measurement), u

    def stop(self):
        self.stops += 1
        self._inner.stop()

    def _shown(self, measurement):
        return measurement._replace(t=self._clock + measurement.t)
