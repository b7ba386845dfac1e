"""Faults of measurements: each has its stated effect, and a fault of size zero has no effect."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import CheapModel, random_state
from retrim.config.faults import FAULTS, NO_FAULT, measurement_fault
from retrim.errors import ConfigError
from retrim.physics import Command, Constant, State, so3
from retrim.plants import SimPlant

START = State.at(jnp.array([0.3, -0.2, 1.5]))
TICKS = 260


def report(fault, tick, rows=30):
    """Return the reported state at a tick of a sequence of random states, and the sequence, newest last."""
    xs = [random_state(random.key(k)) for k in range(rows)]
    past = jax.tree.map(lambda *leaves: jnp.stack(leaves), *xs[-(fault.memory + 1) :])
    return fault(past, jnp.array(tick), random.key(tick)), xs


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.parametrize("name", ["velocity-spikes", "rare-spikes"])
def test_spikes_have_stated_size_and_interval(name):
    fault = measurement_fault(f"{name}=1.5")
    every = int(fault.every)
    for tick in range(0, 3 * every, 7):
        x, xs = report(fault, tick)
        wrong = tick % every == every - 1
        np.testing.assert_allclose(x.v - xs[-1].v, [1.5 * wrong, 0.0, 0.0], atol=1e-12)
        assert_equal((x.p, x.R), (xs[-1].p, xs[-1].R))


def test_swapped_markers_rotate_pose_and_keep_it_valid():
    x, xs = report(measurement_fault("swapped-markers=1.5"), 49)
    np.testing.assert_allclose(x.R.T @ x.R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(so3.log(xs[-1].R.T @ x.R), [0.0, 0.0, 1.5], atol=1e-9)
    assert_equal(report(measurement_fault("swapped-markers"), 10)[0], xs[-1])


@pytest.mark.parametrize("ticks", [1, 3, 7])
def test_late_measurements_have_stated_age(ticks):
    x, xs = report(measurement_fault(f"late={ticks}"), 40)
    assert_equal(x, xs[-1 - ticks])


def test_frozen_measurement_repeats_last_state():
    fault = measurement_fault("frozen=15")
    for tick, back in ((199, 0), (200, 1), (207, 8), (214, 15), (215, 0), (3, 0)):
        x, xs = report(fault, tick)
        assert_equal(x, xs[-1 - back])


def test_repeated_measurements_have_stated_probability():
    fault = measurement_fault("repeated=0.3")
    stale = [np.array_equal(x.p, xs[-2].p) for x, xs in (report(fault, k, rows=2) for k in range(400))]
    assert 0.23 < np.mean(stale) < 0.37


def test_scale_biases_and_drift():
    x, xs = report(measurement_fault("scaled-velocity=0.5"), 3)
    np.testing.assert_allclose(x.v, 0.5 * xs[-1].v)
    x, xs = report(measurement_fault("velocity-bias=0.2"), 3)
    np.testing.assert_allclose(x.v - xs[-1].v, [0.2, 0.0, 0.0], atol=1e-12)
    x, xs = report(measurement_fault("attitude-bias=0.03"), 3)
    np.testing.assert_allclose(so3.log(xs[-1].R.T @ x.R), [0.03, 0.0, 0.0], atol=1e-12)
    drifts = [float((report(measurement_fault("drift=0.1"), k)[0].p - random_state(random.key(29)).p)[0]) for k in
              (0, 62, 63, 125, 187, 188)]  # fmt: skip
    np.testing.assert_allclose(
        drifts, 0.1 * np.sin(2.0 * np.pi * np.array([0, 62, 63, 125, 187, 188]) / 250), atol=1e-9
    )


def test_gaps_and_clock_jumps_change_times_of_plant():
    def times(name):
        plant = SimPlant(CheapModel(0.02), Constant(jnp.zeros(3)), fault=measurement_fault(name))
        plant.reset(START)
        return np.array([plant.step(Command.hover())[0].t for _ in range(TICKS)])

    steps = np.round(np.diff(times("gaps=5")) / 0.02).astype(int)
    assert sorted(set(steps.tolist())) == [1, 6]
    late = times("clock-jumps=0.1") - 0.02 * np.arange(1, TICKS + 1)
    assert sorted({round(v, 9) for v in late.tolist()}) == [0.0, 0.1]


def test_fault_does_not_change_motion():
    """Faults change the measurement, and not the true state."""
    u = Command(jnp.array(10.0), jnp.array([0.5, -0.2, 0.1]))

    def truth(fault):
        plant = SimPlant(CheapModel(0.02), Constant(jnp.array([0.3, 0.0, 0.0])), fault=fault)
        plant.reset(START)
        for _ in range(30):
            measurement, _ = plant.step(u)
        return measurement

    plain = truth(None)
    for name in ("late", "velocity-spikes=2", "scaled-velocity", "repeated"):
        faulty = truth(measurement_fault(name))
        assert_equal(faulty.true_state, plain.true_state)
        assert faulty.t == plain.t
    assert not np.array_equal(truth(measurement_fault("late")).x.p, plain.x.p)


def test_every_registered_fault_has_a_default_size():
    for name in FAULTS:
        assert (measurement_fault(name) is None) == (name == NO_FAULT)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("late=0", "size must be between 1 and 25 ticks, got 0"),
        ("late=x", "'x' is not a number"),
        ("late=1.5", "must be a whole number of ticks, got 1.5"),
        ("frozen=2.5", "must be a whole number of ticks, got 2.5"),
        ("gaps=1.1", "must be a whole number of ticks, got 1.1"),
        ("repeated=1.5", "between 0 and 0.95"),
        ("none=1", "has no size"),
        ("latte", "latte"),
    ],
)
def test_invalid_faults_are_refused_in_one_line(name, words):
    with pytest.raises(ConfigError, match=words) as refusal:
        measurement_fault(name)
    assert "\n" not in str(refusal.value)
