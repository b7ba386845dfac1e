"""Flights that were never flown, for what is computed from flights."""

import numpy as np

from retrim import Log, Scenario
from retrim.experiments import Flight, FlightSpec
from retrim.runtime.flight import States

DT = 0.02


def log(seconds=10.0, *, terminated=False, events=(), t=None):
    t = DT * np.arange(round(seconds / DT) + 1) if t is None else t
    n = len(t)
    states = States(np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)))
    return Log(t, states, states, np.tile([9.81, 0.0, 0.0, 0.0], (n, 1)), DT, terminated, tuple(events))


def flight(error, *, spec=None, flown=None, steady_seconds=2.0, cross=None, **of_log):
    """A flight with this error: a number, or one for each row of the log."""
    flown = log(**of_log) if flown is None else flown
    error = np.broadcast_to(np.asarray(error, dtype=float), flown.t.shape)
    spec = FlightSpec(Scenario("large"), "base", 0) if spec is None else spec
    return Flight(spec, "small", flown, error, "steady_error_m", steady_seconds, cross)
