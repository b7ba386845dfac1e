"""Made-up flights for functions that evaluate flights, and a reporter that records progress."""

import contextlib

import numpy as np

from retrim import Log, Scenario
from retrim.evaluation.executor import Flights
from retrim.evaluation.study import Study
from retrim.runkit import Flight, FlightSpec
from retrim.runkit.reporter import Silent
from retrim.runtime.flight import States

DT = 0.02


def log(seconds=10.0, *, terminated=False, events=(), t=None):
    t = DT * np.arange(round(seconds / DT) + 1) if t is None else t
    n = len(t)
    states = States(np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)))
    return Log(t, states, states, np.tile([9.81, 0.0, 0.0, 0.0], (n, 1)), DT, terminated, tuple(events))


def flight(error, *, spec=None, flight=None, steady_seconds=2.0, cross=None, **of_log):
    """Return a flight with this error: a number, or one for each row of the log."""
    flight = log(**of_log) if flight is None else flight
    error = np.broadcast_to(np.asarray(error, dtype=float), flight.t.shape)
    spec = FlightSpec(Scenario("large"), "base", 0) if spec is None else spec
    return Flight(spec, "small", flight, error, "steady_error_m", steady_seconds, cross)


class Watching(Silent):
    """A reporter that records titles, shares and texts of progress, and forwards each share."""

    def __init__(self, then=lambda share: None):
        self.messages, self._then = [], then

    def progress(self, title):
        def advance(share, text):
            self.messages.append((title, share, text))
            self._then(share)

        return contextlib.nullcontext(advance)

    @property
    def shares(self):
        return [share for _, share, _ in self.messages]


class Imaginary:
    """Made-up training and flights; it records the requests."""

    def __init__(self, error):
        """Set ``error`` [m]: a function of a specification that returns a number, an array, or null for a crash."""
        self._error, self.trainings, self.flights = error, [], []

    def train(self, preset, seeds, run, reporter):
        self.trainings.append((preset, tuple(seeds)))
        return Study(preset, {seed: f"policy {seed}" for seed in seeds}, tuple(0.001 * (1 + s) for s in seeds))

    def fly(self, study, scenarios, run, reporter, *, methods=("base", "full"), starts, seconds, keep=True):
        self.flights.append((study, tuple(scenarios), tuple(methods), starts, seconds))
        specs = [
            FlightSpec(scenario, method, start, seed)
            for scenario in scenarios for method in methods for seed in study.policies for start in range(starts)
        ]  # fmt: skip
        return Flights([self._one(spec, seconds) for spec in specs], interrupted=False)

    def _one(self, spec, seconds):
        error = self._error(spec)
        if error is None:
            return flight(3.0, spec=spec, seconds=2.0, terminated=True)
        return flight(error, spec=spec, seconds=seconds)
