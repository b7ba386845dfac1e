"""The monitor keeps adaptation in calm flights; after errors and oscillations it steps back in order, with a cause."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import CheapModel
from retrim.config import Setup, changed, load
from retrim.config.faults import measurement_fault
from retrim.control.condition import Cause, Stage, describe_condition
from retrim.control.monitor import HOLD, INTERVAL, INTERVALS, MARGIN, Monitor, Twin
from retrim.control.swings import Swings
from retrim.learn import PolicyState
from retrim.physics import Constant, LinearDragQuadrotor, State, small
from retrim.plants.sim import Simulation
from retrim.runtime import stage_events
from retrim.runtime.batch import fly_ticks, take_off

pytestmark = pytest.mark.usefixtures("as_a_user")

DT = 0.02


@pytest.fixture(scope="module")
def hover_case(as_a_user):
    """Return a policy that hovers, and its monitor before any learning."""
    brief = {"hidden_sizes": (32, 32), "num_envs": 8, "num_updates": 200, "horizon": 100, "learning_rate": 0.01}
    setup = Setup.from_preset(changed(load("hover/retrim"), pretrain=brief))
    policy = setup.pretrained(0)
    return setup, policy, setup.controller(setup.learner.init(policy, random.key(0)))


def flight(setup, monitor, *, seconds=4.0, fault=None, later=None, model=CheapModel(DT)):  # noqa: B008
    """Fly from a start; after 2 s the controller ``later`` takes over, if given."""
    push = Constant(jnp.full(3, 0.5, dtype=jnp.float32))
    simulation = Simulation(model, push, None, random.key(0), jnp.array(0.02), fault)
    half, whole = round(2.0 / DT), round(seconds / DT)
    parts = [(monitor, whole)] if later is None else [(monitor, half), (later, whole - half)]

    @eqx.filter_jit
    def fly(parts, x0):
        start, flights = take_off(simulation, monitor, x0), []
        for controller, n in parts:
            start, ticks = fly_ticks(simulation, controller, start, n, room=n)
            flights.append(ticks)
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *flights)

    ticks = fly(parts, setup.flight_starts(1, 4)[0])
    return ticks, np.linalg.norm(np.asarray(ticks.true.p) - np.array(setup.preset.goal), axis=1)


def stages(ticks):
    return np.asarray(ticks.condition.stage)


def test_calm_flight_keeps_adapted_policy(hover_case):
    setup, _, monitor = hover_case
    ticks, error = flight(setup, monitor)
    assert (stages(ticks) == Stage.ADAPTED).all()
    assert error[-25:].max() < 0.02
    assert stage_events(ticks.condition, DT * np.arange(200.0)) == []


def test_worse_policy_is_abandoned(hover_case):
    """From 2 s on, the policy commands a different task, and the monitor returns to the base policy."""
    setup, policy, monitor = hover_case
    worse = eqx.tree_at(lambda p: p.layers[-1].bias, policy, replace_fn=lambda b: b + jnp.array(0.15, b.dtype))
    later = setup.controller(setup.learner.init(worse, random.key(0)))
    ticks, error = flight(setup, monitor, later=later, seconds=9.0)
    changes = stage_events(ticks.condition, DT * np.arange(450.0))
    assert changes[0].kind == "stage"
    assert changes[0].note == describe_condition(Stage.OBSERVED, Cause.ERROR)
    assert 2.0 + (INTERVALS - 1) * INTERVAL < changes[0].t < 2.0 + (INTERVALS + 1) * INTERVAL + DT
    worst = error[(changes[0].t > DT * np.arange(450)) & (DT * np.arange(450) > 2.5)].max()
    assert worst > MARGIN
    assert error[-25:].max() < 0.02 < worst


def test_late_measurements_disable_estimate(hover_case):
    """With measurements 40 ms late, the observer destabilises the vehicle without a monitor and a limited distance."""
    setup, _, monitor = hover_case
    world = {"fault": measurement_fault("late=2"), "model": LinearDragQuadrotor.of(small(), DT), "seconds": 8.0}
    unlimited = dataclasses.replace(monitor.frame, inner=monitor.frame.inner.inner)
    _, error = flight(setup, unlimited, **world)
    assert not error[-50:].max() < 10.0
    for controller in (dataclasses.replace(monitor, frame=unlimited), monitor, monitor.frame):
        _, error = flight(setup, controller, **world)
        assert error[-50:].max() < 0.5


def judge_excess(monitor, memory, *, excess, ticks=1):
    """Return the memory after intervals whose errors exceed those of the twin by ``excess`` [m]."""
    x = State.at(jnp.array([0.0, 0.0, 1.0], jnp.float32))
    last = round(INTERVAL / DT)
    for _ in range(ticks):
        twin = Twin(memory.twin.x, memory.twin.memory, jnp.float32(excess * last), jnp.array(last - 1))
        memory = judge(monitor, dataclasses.replace(memory, twin=twin), jnp.float32(0.0), x)
    return memory


@eqx.filter_jit
def begin(monitor, x):
    return monitor.init(x)


@eqx.filter_jit
def judge(monitor, memory, t, x):
    return monitor(memory, t, x)[1]


def test_steps_back_are_ordered_and_grow_longer(hover_case):
    _, _, monitor = hover_case
    memory = begin(monitor, State.at(jnp.array([0.0, 0.0, 1.0], jnp.float32)))
    waits = []
    for stage in (Stage.OBSERVED, Stage.SLOW, Stage.BASE):
        memory = judge_excess(monitor, memory, excess=2.0 * MARGIN, ticks=INTERVALS)
        assert int(memory.stage) == stage
        assert int(memory.cause) == Cause.ERROR
        waits.append(float(memory.wait))
    np.testing.assert_allclose(waits, [HOLD, 2 * HOLD, 4 * HOLD], atol=0.1)
    memory = judge_excess(monitor, memory, excess=0.9 * MARGIN, ticks=INTERVALS)
    assert int(memory.stage) == Stage.BASE
    ready = dataclasses.replace(memory, wait=jnp.zeros_like(memory.wait))
    back = judge_excess(monitor, ready, excess=0.0)
    assert (int(back.stage), int(back.cause)) == (Stage.SLOW, Cause.RECOVERY)


def step_back_to_base(monitor, excess):
    memory = begin(monitor, State.at(jnp.array([0.0, 0.0, 1.0], jnp.float32)))
    memory = judge_excess(monitor, memory, excess=excess, ticks=3 * INTERVALS)
    assert int(memory.stage) == Stage.BASE
    return memory


def test_error_shared_by_base_policy_is_tolerated(hover_case):
    """The state estimate of an autopilot may wander by centimetres under every policy."""
    _, _, monitor = hover_case
    memory = judge_excess(monitor, step_back_to_base(monitor, 0.06), excess=0.05, ticks=INTERVALS)
    assert (int(memory.stage), int(memory.cause)) == (Stage.ADAPTED, Cause.NO_GAIN)
    memory = judge_excess(monitor, memory, excess=0.1, ticks=2 * INTERVALS)
    assert int(memory.stage) == Stage.ADAPTED
    memory = judge_excess(monitor, memory, excess=0.2, ticks=INTERVALS)
    assert int(memory.stage) == Stage.OBSERVED


def test_better_base_policy_is_kept(hover_case):
    _, _, monitor = hover_case
    memory = judge_excess(monitor, step_back_to_base(monitor, 0.2), excess=0.09, ticks=2 * INTERVALS)
    assert int(memory.stage) == Stage.BASE


def test_oscillation_is_not_tolerated(hover_case):
    _, _, monitor = hover_case
    memory = step_back_to_base(monitor, 0.06)
    memory = dataclasses.replace(memory, best=jnp.array(int(Stage.SLOW)))
    assert int(judge_excess(monitor, memory, excess=0.06, ticks=2 * INTERVALS).stage) == Stage.BASE


def test_few_bad_intervals_change_nothing(hover_case):
    _, _, monitor = hover_case
    memory = begin(monitor, State.at(jnp.array([0.0, 0.0, 1.0], jnp.float32)))
    for _ in range(3):
        memory = judge_excess(monitor, memory, excess=2.0 * MARGIN, ticks=INTERVALS - 1)
        memory = judge_excess(monitor, memory, excess=0.5 * MARGIN)
    assert int(memory.stage) == Stage.ADAPTED
    # a large error: one interval suffices
    assert int(judge_excess(monitor, memory, excess=1.0).stage) == Stage.OBSERVED


def test_second_oscillation_is_final(hover_case):
    _, _, monitor = hover_case
    memory = begin(monitor, State.at(jnp.array([0.0, 0.0, 1.0], jnp.float32)))
    wild = lambda m: dataclasses.replace(m, swings=dataclasses.replace(m.swings, size=jnp.float32(100.0)))  # noqa: E731
    x = State.at(jnp.array([0.0, 0.0, 1.0], jnp.float32))
    once = judge(monitor, wild(memory), jnp.float32(0.0), x)
    assert (int(once.stage), int(once.best), int(once.cause)) == (Stage.BASE, Stage.SLOW, Cause.OSCILLATION)
    back = judge_excess(monitor, dataclasses.replace(once, wait=jnp.float32(0.0)), excess=0.0)
    assert int(back.stage) == Stage.SLOW
    twice = judge(monitor, wild(back), jnp.float32(0.0), x)
    assert (int(twice.stage), int(twice.best)) == (Stage.BASE, Stage.BASE)
    calm = judge_excess(monitor, dataclasses.replace(twice, wait=jnp.float32(0.0)), excess=0.0)
    assert int(calm.stage) == Stage.BASE


def test_swing_measure_counts_reversals_not_steps():
    def size(ds):
        def tick(s, d):
            s = s.after(d, DT)
            return s, s.size

        return float(jnp.max(jax.lax.scan(tick, Swings.none(jnp.zeros(3)), ds)[1]))

    t = DT * jnp.arange(250.0)
    along_x = jnp.array([1.0, 0.0, 0.0])
    assert size(jnp.where(t < 1.0, 0.0, 3.0)[:, None] * along_x) == pytest.approx((3.0 / 4.0) ** 2, rel=1e-6)
    assert size(0.9 * jnp.sin(6.0 * t)[:, None] * along_x) == 0.0  # smaller than a swing
    slow = size(4.0 * jnp.sin(1.0 * t)[:, None] * along_x)
    fast = size(4.0 * jnp.sin(8.0 * t)[:, None] * along_x)
    assert slow < 8.0 < fast


def test_monitor_has_frame_of_setup(hover_case):
    setup, policy, monitor = hover_case
    assert isinstance(monitor, Monitor)
    again = setup.controller(setup.learner.init(policy, random.key(1)))
    assert jax.tree.structure(again.frame.observer) == jax.tree.structure(monitor.frame.observer)
    assert isinstance(setup.learner.init(policy, random.key(1)).policy, PolicyState)
