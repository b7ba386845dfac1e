"""Sensors: stated noise and latency, repeated samples after losses, and reproducible noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import CheapModel, random_state
from retrim.physics import Command, Constant, State, so3
from retrim.plants import SensorModel, SimPlant
from retrim.runtime import FunctionPilot, fly

START = State.at(jnp.array([0.3, -0.2, 1.5]))
TURN = Command(jnp.array(11.0), jnp.array([1.0, -0.5, 0.5]))


def plant(sensors=None, seed=0, dt=0.02):
    return SimPlant(CheapModel(dt), Constant(jnp.zeros(3)), sensors=sensors, seed=seed)


def samples(plant, ticks=30, u=TURN):
    return [plant.reset(START), *(plant.step(u)[0] for _ in range(ticks))]


def stack(states):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *states)


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_ideal_sensors_return_true_state():
    """The motion is equal with and without sensors."""
    plain, ideal, rough = (
        samples(plant(sensors))
        for sensors in (None, SensorModel.of(), SensorModel.of(position=0.1, dropout=0.5, latency=20))
    )
    for a, b, c in zip(plain[1:], ideal[1:], rough[1:], strict=True):
        assert_equal(a.x, a.truth)
        assert_equal(b.x, a.truth)
        assert_equal(b.truth, a.truth)
        assert_equal(c.truth, a.truth)


def test_noise_has_stated_deviation(key):
    sensors, x, n = SensorModel.of(position=0.01, velocity=0.2, attitude=0.03), random_state(key), 20_000

    @jax.jit
    @jax.vmap
    def errors(key):
        observation = sensors.noisy(x, key)
        return (observation.p - x.p, observation.v - x.v, so3.log(x.R.T @ observation.R)), observation.R

    result, R = jax.tree.map(np.asarray, errors(random.split(key, n)))
    for error, sigma in zip(result, (0.01, 0.2, 0.03), strict=True):
        np.testing.assert_allclose(error.std(axis=0), sigma, rtol=0.03)
        np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=5 * sigma / n**0.5)
        correlation = np.corrcoef(error.T) - np.eye(3)
        assert np.abs(correlation).max() < 0.05
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)


def test_samples_of_flight_have_new_noise_every_tick():
    """The samples pass through the plant."""
    flight = samples(plant(SensorModel.of(position=0.01)), ticks=400, u=Command.hover())[1:]
    error = np.stack([s.x.p - s.truth.p for s in flight])
    np.testing.assert_allclose(error.std(axis=0), 0.01, rtol=0.15)
    assert np.abs(np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]) < 0.2
    assert_equal(flight[0].x.v, flight[0].truth.v)


def test_sample_shows_state_before_latency():
    """A sample shows the state 20 ms earlier, and the start before the first sample arrives."""
    flight = samples(plant(SensorModel.of(latency=20)))
    assert_equal(flight[1].x, START)
    for late, then in zip(flight[2:], flight[1:-1], strict=True):
        assert_equal(late.x, then.truth)
    assert not np.array_equal(flight[-1].x.p, flight[-1].truth.p)


def test_latency_between_ticks():
    """With samples every 10 ms and a latency of 5 ms, the newest available sample is half of a 20 ms tick old."""
    fine, coarse = samples(plant(dt=0.01), ticks=20), samples(plant(SensorModel.of(latency=5)), ticks=10)
    for i in range(1, 11):
        np.testing.assert_allclose(coarse[i].x.vector(), fine[2 * i - 1].x.vector(), atol=1e-12)


@pytest.mark.parametrize("latency", [0, 5, 10, 15, 20, 33])
def test_sample_has_stated_age(latency):
    """If the latency is not a multiple of the period, the sample at the end of a tick is older than the latency."""
    fine, late = samples(plant(dt=0.001), ticks=200), samples(plant(SensorModel.of(latency=latency)), ticks=10)
    for m in late[3:]:
        assert m.age >= 1e-3 * latency
        then = fine[round(1000 * (m.t - m.age))]
        np.testing.assert_allclose(m.x.vector(), then.truth.vector(), atol=1e-12)


def test_dropout_holds_last_sample():
    flight = samples(plant(SensorModel.of(dropout=0.5), seed=3), ticks=400)
    observation = np.stack([s.x.vector() for s in flight[1:]])
    hold = np.mean((observation[1:] == observation[:-1]).all(axis=1))
    assert hold == pytest.approx(0.25, abs=0.08)  # both samples of a tick are lost
    fresh = np.mean((observation == np.stack([s.truth.vector() for s in flight[1:]])).all(axis=1))
    assert fresh == pytest.approx(0.5, abs=0.1)


def test_held_sample_keeps_its_noise(key):
    """No new noise is drawn while samples are lost."""
    sensors = SensorModel.of(position=0.1, dropout=0.999999)
    first = sensors.noisy(START, key)
    queue = jax.tree.map(lambda leaf: leaf[None], first)
    moving = stack([START, random_state(key), random_state(key, 2.0)])
    assert_equal(sensors.sample(queue, jax.tree.map(jnp.asarray, moving), None, jnp.zeros(3), 0.02, key), queue)


def test_seed_repeats_bit_for_bit():
    rough = SensorModel.of(position=0.01, velocity=0.1, attitude=0.01, dropout=0.2, latency=20)
    one = plant(rough, seed=1)
    first, again = samples(one), samples(one)
    other, different = samples(plant(rough, seed=1)), samples(plant(rough, seed=2))
    for a, b, c, d in zip(first[1:], again[1:], other[1:], different[1:], strict=True):
        assert_equal(a.x, b.x)
        assert_equal(a.x, c.x)
        assert_equal(a.truth, d.truth)
    assert not np.array_equal(first[-1].x.p, different[-1].x.p)


@pytest.mark.parametrize(
    ("field", "value"),
    [("position", -1e-3), ("velocity", -1.0), ("attitude", float("nan")), ("dropout", 1.0), ("dropout", -0.1)],
)
def test_invalid_sensors_are_refused(field, value):
    with pytest.raises(ValueError, match=rf"SensorModel\.{field} = {value}"):
        SensorModel.of(**{field: value})


def test_invalid_times_are_refused():
    with pytest.raises(ValueError, match="latency = -1 ms"):
        SensorModel.of(latency=-1)
    zero = jnp.array(0.0)
    with pytest.raises(ValueError, match="period = 0 ms"):
        SensorModel(zero, zero, zero, zero, 0, 0)
    with pytest.raises(ValueError, match="not a multiple of the 10 ms of SensorModel"):
        plant(SensorModel.of(), dt=0.025)


def test_log_has_true_and_measured_states():
    observation = []
    rough = SensorModel.of(position=0.05, latency=20)
    pilot = FunctionPilot(lambda measurement: observation.append(measurement) or TURN)
    log = fly(plant(rough), pilot, START, ticks=10)
    truth = samples(plant(), ticks=10)
    np.testing.assert_array_equal(log.p, np.stack([s.x.p for s in truth]))
    np.testing.assert_array_equal(log.R, np.stack([s.x.R for s in truth]))
    np.testing.assert_array_equal(log.measured.p[:-1], np.stack([s.x.p for s in observation]))
    assert not np.array_equal(observation[-1].x.p, log.p[-2])  # the pilot receives the output of the sensors
    assert_equal(observation[-1].true_state.p, log.p[-2])
