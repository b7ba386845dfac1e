"""The flight loop: clock origins, missed ticks, limited commands, and observers."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import hover_task
from odd_plant import OddPlant
from retrim import PlantError
from retrim.adapt import RollingBuffer, Skip
from retrim.control import AbstractController, Policy, PolicyController
from retrim.physics import Command, State, small
from retrim.runtime import ControllerPilot, Event, FlightStopped, FunctionPilot, Pilot, fly

START = State.at(jnp.array([0.3, -0.2, 1.5]))
HOVER = FunctionPilot(lambda measurement: Command.hover())


class RecordingObserver:
    """An observer that stores its inputs in order."""

    def __init__(self):
        self.calls = []

    def measurement(self, measurement, u):
        self.calls.append((measurement, u))

    def event(self, event):
        self.calls.append(event)


class Climb(AbstractController[None]):
    """Commands thrust as a function of the time since the start of the flight."""

    def init(self, x):
        return None

    def __call__(self, memory, t, x):
        return Command(9.81 + t, jnp.zeros(3)), None


class PilotWithEvent(Pilot):
    """A pilot that hovers, and reports an event at its third tick."""

    def __init__(self):
        self._t, self._start = 0.0, 0.0

    def reset(self, measurement):
        self._start = measurement.t

    def act(self, measurement):
        self._t = measurement.t - self._start
        return Command.hover()

    def take_events(self):
        return [Event.of(self._t, Skip(self._t, "policy"))] if round(self._t / 0.02) == 2 else []


def policy_controller(key, history=2):
    task = hover_task(history=history)
    policy = Policy.of(task.observation.size, small(), key=key, hidden=(8,))
    return PolicyController(task.observation, jax.tree.map(lambda leaf: leaf + 0.05, policy))


# ---- time


def test_flight_is_independent_of_clock_origin():
    """Pilots receive the time since the start of the flight for any clock of the plant."""
    calls = []

    def late(t, x):
        calls.append(t)
        return t > 0.29

    flight = [
        fly(OddPlant(clock=clock), ControllerPilot(Climb()), START, ticks=50, terminated=late) for clock in (0.0, 1.7e9)
    ]
    for log in flight:
        assert len(log.t) == 16
        assert log.t[0] == 0.0
        assert log.terminated
        np.testing.assert_allclose(log.t, 0.02 * np.arange(16), atol=1e-6)
        np.testing.assert_allclose(log.u[1:, 0], 9.81 + 0.02 * np.arange(15), atol=1e-6)
    np.testing.assert_allclose(calls, 2 * list(0.02 * np.arange(1, 16)), atol=1e-6)
    np.testing.assert_allclose(flight[1].p, flight[0].p, atol=1e-6)


def test_missed_ticks_count_as_flight_time():
    """The clock jumps by three ticks at the fifth and eighth step: 20 ticks take 16 steps."""
    plant = OddPlant(stalls=(4, 7))
    log = fly(plant, HOVER, START, ticks=20)
    assert log.missed_ticks == 4
    assert len(log.t) == 17
    assert log.t[-1] == pytest.approx(0.4)
    steps = np.full(16, 0.02)
    steps[[4, 7]] = 0.06
    np.testing.assert_allclose(np.diff(log.t), steps)
    assert fly(OddPlant(), HOVER, START, ticks=20).missed_ticks == 0


# ---- commands that a plant limits


def limit(u):
    return Command(jnp.clip(u.c, 9.5, 10.0), jnp.clip(u.omega, -0.05, 0.05))


def test_log_and_observation_have_accepted_command(key):
    """The next observation of the policy has the accepted command: a replay with it reproduces each issued command."""
    controller, plant = policy_controller(key), OddPlant(limit=limit)
    log = fly(plant, ControllerPilot(controller), START, ticks=12)
    commands = np.stack([u.vector() for u in plant.commands])
    accepted_command = np.stack([limit(u).vector() for u in plant.commands])
    assert not np.allclose(commands, accepted_command)
    np.testing.assert_array_equal(log.u[1:], accepted_command)
    np.testing.assert_array_equal(log.u[0], Command.hover().vector())

    def replay(message):
        memory, result = controller.init(START), []
        for k in range(12):
            x = State(*(jnp.asarray(leaf[k]) for leaf in log.measured))
            u, memory = controller(memory, jnp.array(0.02 * k), x)
            result.append(u.vector())
            if message:
                memory = controller.accept(memory, limit(u))
        return np.stack(result)

    np.testing.assert_allclose(replay(message=True), commands, atol=1e-12)
    assert not np.allclose(replay(message=False), commands, atol=1e-6)


# ---- the record


def test_window_of_log_equals_window_in_flight(key):
    """In a log and in a buffer, each measured, noisy state is paired with the command that followed it."""
    buffer, inner = RollingBuffer(10), ControllerPilot(policy_controller(key))

    class BufferingPilot(Pilot):
        def reset(self, measurement):
            inner.reset(measurement)

        def act(self, measurement):
            u = inner.act(measurement)
            buffer.push(measurement.t, measurement.x, u, measurement.age)
            return u

        def accept(self, u):
            inner.accept(u)
            buffer.accept(u)

    log = fly(OddPlant(sensors="rough", limit=limit), BufferingPilot(), START, ticks=15)
    observation, window = buffer.window(), log.window(10)
    for a, b in zip(jax.tree.leaves(observation), jax.tree.leaves(window), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    assert not np.allclose(window.x.p, log.p[5:15], atol=1e-6)  # measured, not true
    earlier = log.window(4, end=9)
    np.testing.assert_array_equal(earlier.x.p, log.measured.p[5:9])
    np.testing.assert_array_equal(earlier.u.c, log.u[6:10, 0])
    with pytest.raises(ValueError, match="16 ticks up to row 15 of a flight of 15 ticks"):
        log.window(16)
    with pytest.raises(ValueError, match="4 ticks up to row 16"):
        log.window(4, end=16)


def test_log_of_noisy_plant_has_true_and_measured_states():
    log = fly(OddPlant(sensors="mocap"), HOVER, START, ticks=8)
    np.testing.assert_array_equal(log.p, fly(OddPlant(), HOVER, START, ticks=8).p)
    assert np.all(np.any(log.measured.p != log.true.p, axis=1))


# ---- observers


def test_observers_receive_all_measurements_and_events():
    witness, second, plant = RecordingObserver(), RecordingObserver(), OddPlant(clock=100.0)
    log = fly(plant, PilotWithEvent(), START, ticks=5, observers=[witness, second])
    measurements = [message for message in witness.calls if not isinstance(message, Event)]
    assert len(measurements) == 6
    first, u = measurements[0]
    np.testing.assert_array_equal(first.x.vector(), START.vector())
    np.testing.assert_array_equal(u.vector(), Command.hover().vector())
    np.testing.assert_array_equal(log.p, np.stack([m.x.p for m, _ in measurements]))
    (event,) = [message for message in witness.calls if isinstance(message, Event)]
    assert event == Event(event.t, "skipped", "policy learner still busy")
    assert event.t == pytest.approx(0.04)
    assert log.events == (event,)
    assert [type(message) for message in witness.calls] == [type(message) for message in second.calls]
    assert witness.calls.index(event) == 3  # in the tick of the event, before its measurement


def test_stop_token_ends_flight_and_stops_plant():
    stop, witness, plant = threading.Event(), RecordingObserver(), OddPlant()

    def until_the_third(measurement):
        if measurement.t > 0.03:
            stop.set()
        return Command.hover()

    with pytest.raises(FlightStopped, match="aborted"):
        fly(plant, FunctionPilot(until_the_third), START, ticks=50, observers=[witness], stop=stop)
    assert plant.stops == 1
    assert len(plant.commands) == 3
    assert len(witness.calls) == 4
    with pytest.raises(PlantError, match="call reset first"):
        plant.step(Command.hover())


def test_failing_pilot_stops_plant():
    plant = OddPlant()

    def failing(measurement):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fly(plant, FunctionPilot(failing), START, ticks=5)
    assert plant.stops == 1


def test_termination_ends_flight_and_is_logged():
    log = fly(OddPlant(), HOVER, START, ticks=50, terminated=lambda t, x: t >= 0.1 - 1e-9)
    assert log.terminated
    assert log.t[-1] == pytest.approx(0.1)
    assert not fly(OddPlant(), HOVER, START, ticks=5).terminated


def test_termination_depends_on_true_state():
    observation = []
    fly(OddPlant(sensors="rough"), HOVER, START, ticks=5, terminated=lambda t, x: observation.append(x.p) or False)
    np.testing.assert_array_equal(np.stack(observation), fly(OddPlant(), HOVER, START, ticks=5).p[1:])


def test_pilot_resets_memory_at_time_zero(key):
    pilot, plant = ControllerPilot(policy_controller(key)), OddPlant()
    with plant:
        start = plant.reset(START)
        pilot.reset(start)
        first = pilot.act(start).vector()
        pilot.act(plant.step(Command.hover())[0])
    pilot.reset(start._replace(t=50.0))
    np.testing.assert_array_equal(pilot.act(start._replace(t=50.0)).vector(), first)


@pytest.mark.parametrize("ticks", [0, 3])
def test_command_that_is_not_finite_ends_flight(ticks):
    """The plant never receives it, and is stopped."""
    plant = OddPlant()
    count = iter(range(10))
    pilot = FunctionPilot(
        lambda measurement: Command(jnp.array(9.81 if next(count) < ticks else jnp.nan), jnp.zeros(3))
    )
    log = fly(plant, pilot, START, ticks=8)
    assert log.terminated
    assert len(log.t) == ticks + 1
    assert [event.kind for event in log.events] == ["terminated"]
    assert "nan" in log.events[0].note
    with pytest.raises(PlantError):
        plant.step(Command.hover())
