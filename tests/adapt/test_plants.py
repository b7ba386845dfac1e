"""Conformance: what every plant must do. A new plant is one more row in PLANTS."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import random_state
from retrim import build, presets
from retrim.adapt import ControllerPilot, Plant, PlantError, SimPlant, fly
from retrim.control import AbstractController
from retrim.physics import Command, Constant, Push, Rotors, State, small
from retrim.testbed import Setting

PLANTS = {name: Setting(name).make for name in ("bem", "simple")}
START = State.at(jnp.array([0.3, -0.2, 1.5]))


@pytest.fixture(params=list(PLANTS))
def plant(request):
    return PLANTS[request.param]("none")


def test_is_a_plant(plant):
    assert isinstance(plant, Plant)


def test_reset_puts_it_where_it_is_told(plant, key):
    for x0 in (START, random_state(key, 0.3)):
        sample = plant.reset(x0)
        assert sample.t == 0.0
        jax.tree.map(np.testing.assert_array_equal, sample.x, x0)


def test_ticks(plant):
    plant.reset(START)
    times = [plant.exchange(Command.hover()).t for _ in range(5)]
    np.testing.assert_allclose(times, plant.dt * np.arange(1, 6), atol=1e-12)


def test_reset_forgets(plant):
    def flight():
        plant.reset(START)
        return [plant.exchange(Command(jnp.array(11.0), jnp.array([1.0, 0.5, 0.2]))).x.vector() for _ in range(10)]

    np.testing.assert_array_equal(flight(), flight())


def test_hover_hovers(plant):
    plant.reset(START)
    for _ in range(10):
        sample = plant.exchange(Command.hover())
    assert float(jnp.linalg.norm(sample.x.p - START.p)) < 0.05


def test_command_acts_after_the_delay_and_is_reported(plant):
    """The command of tick k moves the vehicle from tick k + delay on, not before."""
    rolling, plain = [], []
    for rates, into in ((jnp.array([3.0, 0.0, 0.0]), rolling), (jnp.zeros(3), plain)):
        plant.reset(START)
        for _ in range(4):
            u = Command(jnp.array(9.81), rates)
            sample = plant.exchange(u)
            np.testing.assert_array_equal(sample.u.vector(), u.vector())
            into.append(np.asarray(sample.x.R))
    assert np.array_equal(rolling[0], plain[0])  # 20 ms of delay: one tick
    assert not np.array_equal(rolling[1], plain[1])


@pytest.mark.parametrize(
    ("c", "omega", "name"),
    [(float("nan"), [0, 0, 0], "c = nan"), (9.81, [0, float("inf"), 0], r"omega\[1\] = inf")],
)
def test_a_command_that_is_not_finite_is_refused_by_name(plant, c, omega, name):
    plant.reset(START)
    with pytest.raises(PlantError, match=f"command refused, {name} is not finite"):
        plant.exchange(Command(jnp.array(c), jnp.array(omega, dtype=float)))
    assert plant.exchange(Command.hover()).t == pytest.approx(plant.dt)  # and nothing was lost


def test_stop_is_idempotent_and_final(plant):
    plant.stop()
    plant.reset(START)
    plant.stop()
    plant.stop()
    with pytest.raises(PlantError, match="call reset first"):
        plant.exchange(Command.hover())
    assert plant.reset(START).t == 0.0


class Broken(AbstractController[None]):
    def init(self, x):
        return None

    def __call__(self, memory, t, x):
        return Command(jnp.where(t > 0.05, jnp.nan, 9.81), jnp.zeros(3)), None


def test_flight_stops_the_plant_whatever_happens(plant):
    with pytest.raises(PlantError, match="c = nan is not finite"):
        fly(plant, ControllerPilot(Broken()), START, ticks=10)
    with pytest.raises(PlantError, match="call reset first"):
        plant.exchange(Command.hover())


class Witness:
    def __init__(self):
        self.samples = []

    def state(self, sample):
        self.samples.append(sample)

    def event(self, kind, **data):
        raise AssertionError(kind)


def test_log_and_sinks_see_every_tick(plant):
    witness = Witness()
    log = fly(plant, lambda sample: Command.hover(), START, ticks=7, sinks=[witness])
    assert log.t.shape == (8,)
    assert log.p.shape == (8, 3)
    assert log.R.shape == (8, 3, 3)
    assert log.u.shape == (8, 4)
    assert not log.crashed
    np.testing.assert_array_equal(log.p[1:], [s.x.p for s in witness.samples])


def test_a_crash_ends_the_flight_and_is_logged(plant):
    log = fly(plant, lambda s: Command.hover(), START, ticks=50, alive=lambda s: s.t < 0.1)
    assert log.crashed
    assert log.t[-1] == pytest.approx(0.1)


# ---- the simulated plant's own


def flown(delay, ticks=40):
    plant = SimPlant(Rotors.of(small(), 0.02), Constant(jnp.zeros(3)), delay=delay)
    plant.reset(START)
    return [plant.exchange(Command(jnp.array(9.81), jnp.array([1.0, 0.0, 0.0]))).x.R for _ in range(ticks)]


def test_delay_shifts_the_response():
    now, late, later = flown(0.0), flown(0.02), flown(0.04)
    np.testing.assert_allclose(late[1:], now[:-1], atol=1e-12)
    np.testing.assert_allclose(later[2:], now[:-2], atol=1e-12)
    between = flown(0.025)  # not a whole tick: between one and two
    angle = lambda Rs: float(Rs[4][2, 1])  # noqa: E731
    assert angle(later) < angle(between) < angle(late)


@pytest.mark.parametrize("delay", [-0.01, 0.0205])
def test_impossible_delays(delay):
    with pytest.raises(ValueError, match="whole, non-negative number of milliseconds"):
        SimPlant(Rotors.of(small(), 0.02), Constant(jnp.zeros(3)), delay=delay)


def test_disturbance_accelerates():
    push = jnp.array([0.5, 0.0, 0.0])
    plant = SimPlant(Rotors.of(small(), 0.02), Constant(push))
    plant.reset(START)
    for _ in range(5):
        sample = plant.exchange(Command.hover())
    assert float(sample.x.v[0]) == pytest.approx(0.05, rel=0.05)


def test_any_function_of_time_and_state_is_a_disturbance():
    plant = SimPlant(Rotors.of(small(), 0.02), Push(lambda t, x: -10.0 * x.v + jnp.where(t < 0.1, 1.0, 0.0)))
    plant.reset(START)
    for _ in range(100):
        sample = plant.exchange(Command.hover())
    assert np.isfinite(sample.x.vector()).all()


def test_flights_are_in_the_dtype_of_their_start():
    plant = PLANTS["bem"]("none")
    with jax.enable_x64(False):
        plant32 = PLANTS["bem"]("none")
        x0 = build.flight_starts(presets.load("fast"), 1)[0]
        assert plant32.reset(x0).x.p.dtype == jnp.float32
        assert plant32.exchange(Command.hover()).x.p.dtype == jnp.float32
    assert plant.reset(START).x.p.dtype == jnp.float64
