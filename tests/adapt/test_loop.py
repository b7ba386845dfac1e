"""The loop as a whole: buffer, gate, adapter, and the virtual clock that charges compute to flight time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import hover_task, tiny_preset
from retrim.adapt import AdaptivePilot, ControllerPilot, Measurement, Schedule, fly
from retrim.adapt.buffer import RollingBuffer
from retrim.adapt.gate import judge
from retrim.adapt.learner import OnlineLearner
from retrim.config import factory as build
from retrim.config import presets
from retrim.config.registry import Scenario
from retrim.control import Policy, PolicyController
from retrim.learn import PolicyState, pretrain
from retrim.physics import Command, State, small

pytestmark = pytest.mark.usefixtures("optax_promotion")


def at(*p):
    return State.at(jnp.array(p))


# ---- buffer


def test_window_has_a_fixed_shape_and_masks_what_is_missing():
    buffer = RollingBuffer(4)
    with pytest.raises(ValueError, match="no tick was pushed"):
        buffer.window()
    for i in range(6):
        buffer.push(0.02 * i, at(float(i), 0.0, 1.0), Command(jnp.array(float(i)), jnp.zeros(3)))
        window = buffer.window()
        assert window.x.p.shape == (4, 3)
        assert int(window.valid.sum()) == min(i + 1, 4)
        newest = np.arange(max(0, i - 3), i + 1)
        np.testing.assert_allclose(window.t[np.asarray(window.valid)], 0.02 * newest)
        np.testing.assert_array_equal(window.x.p[np.asarray(window.valid), 0], newest)
        np.testing.assert_array_equal(window.u.c[np.asarray(window.valid)], newest)


def test_window_is_a_copy():
    buffer = RollingBuffer(2)
    buffer.push(0.0, at(1.0, 0.0, 1.0), Command.hover())
    before = buffer.window()
    buffer.push(0.0, at(2.0, 0.0, 1.0), Command.hover())
    buffer.push(0.0, at(3.0, 0.0, 1.0), Command.hover())
    assert float(before.x.p[-1, 0]) == 1.0


def test_a_log_gives_the_window_that_was_seen_in_flight(trained):
    """Of a log and of a buffer, each state stands with the command that followed it."""
    preset, policy = trained[:2]
    buffer, inner = RollingBuffer(10), ControllerPilot(PolicyController(build.task(preset).observation, policy))

    def pilot(sample):
        u = inner(sample)
        buffer.push(sample.t, sample.x, u)
        return u

    log = fly(Scenario("simple").make("small"), pilot, build.flight_starts(preset, 1)[0], ticks=15)
    seen, kept = buffer.window(), log.window(10)
    for a, b in zip(jax.tree.leaves(seen), jax.tree.leaves(kept), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    with pytest.raises(ValueError, match="16 ticks of a flight of 15"):
        log.window(16)


def test_buffer_size():
    with pytest.raises(ValueError, match="size = 1 must be at least 2"):
        RollingBuffer(1)


# ---- gate


@pytest.fixture(scope="module")
def trained():
    """A fresh policy and one that hovers better, with the preset of both."""
    with jax.numpy_dtype_promotion("standard"):
        preset = tiny_preset()
        fresh = build.policy(preset, random.key(0))
        *_, (state, _) = pretrain(
            fresh,
            build.nominal(preset),
            build.task(preset),
            random.key(1),
            optimiser=build.optimiser(preset),
            epochs=60,
            envs=8,
            delay=1,
        )
        return preset, fresh, state.policy


def verdict(candidate, incumbent, preset):
    task = build.task(preset)
    x0 = jax.vmap(task.reset)(random.split(random.key(5), 4))
    return judge(candidate, incumbent, build.nominal(preset), task, x0, delay=preset.delay)


def test_gate_admits_the_better_and_refuses_the_worse(trained):
    preset, fresh, better = trained
    found = verdict(better, fresh, preset)
    assert bool(found.admitted)
    assert float(found.candidate) < float(found.incumbent)
    found = verdict(fresh, better, preset)
    assert not bool(found.admitted)
    assert "worse than the incumbent" in found.reason()


def test_gate_refuses_nan_by_name(trained):
    preset, fresh, _ = trained
    broken = eqx.tree_at(lambda p: p.layers[1].bias, fresh, fresh.layers[1].bias.at[3].set(jnp.nan))
    found = verdict(broken, fresh, preset)
    assert not bool(found.admitted)
    assert found.reason() == "a weight is not finite"


def test_gate_admits_an_equal_and_replaces_a_broken_incumbent(trained):
    preset, fresh, _ = trained
    assert bool(verdict(fresh, fresh, preset).admitted)
    broken = eqx.tree_at(lambda p: p.layers[1].bias, fresh, fresh.layers[1].bias.at[3].set(jnp.nan))
    assert bool(verdict(fresh, broken, preset).admitted)


# ---- adapter


@pytest.mark.parametrize(("field", "value"), [("iters", 0), ("epochs", 0), ("envs", -1), ("delay", -1)])
def test_impossible_sizes_are_refused_at_construction(field, value):
    adapter = build.adapter(tiny_preset())
    fields = {name: getattr(adapter, name) for name in adapter.__dataclass_fields__}
    with pytest.raises(ValueError, match=rf"OnlineLearner\.{field} = {value}"):
        OnlineLearner(**(fields | {field: value}))


def pilot(preset, policy, *, schedule=None, sinks=()):
    adapter = build.adapter(preset)
    state = adapter.init(policy, build.residual(preset, random.key(2)))
    return AdaptivePilot(
        adapter,
        state,
        schedule or build.schedule(preset),
        random.key(3),
        dt=presets.DT,
        window=preset.adapt.window,
        sinks=sinks,
    )


def adaptive_flight(preset, policy, seconds, **options):
    flying = pilot(preset, policy, **options)
    plant = Scenario("simple").make("large")
    log = fly(plant, flying, build.flight_starts(preset, 1)[0], ticks=round(seconds / presets.DT))
    return log, flying


BRISK = Schedule(0.6, 1.0, 0.1, 0.3)


def test_lockstep_repeats_bit_for_bit(trained):
    preset, _, policy = trained
    first, one = adaptive_flight(preset, policy, 3.2, schedule=BRISK)
    second, two = adaptive_flight(preset, policy, 3.2, schedule=BRISK)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert one.events == two.events
    assert {"residual"} < {e.kind for e in one.events}
    jax.tree.map(np.testing.assert_array_equal, one.state, two.state)


def test_results_appear_only_after_their_charge(trained):
    """Residuals are due every 0.6 s and cost 0.1 s; policies every 1 s and cost 0.3 s."""
    preset, _, policy = trained
    _, flown = adaptive_flight(preset, policy, 3.0, schedule=BRISK)
    times = lambda *kinds: [e.t for e in flown.events if e.kind in kinds]  # noqa: E731
    np.testing.assert_allclose(times("residual"), [0.7, 1.3, 1.9, 2.5], atol=1e-9)
    np.testing.assert_allclose(times("policy", "rejected"), [1.3, 2.3], atol=1e-9)


def test_commands_are_the_old_policys_until_the_swap(trained):
    """The flight equals an unadapted one up to the tick at which the first policy appears, and differs after it."""
    preset, _, policy = trained
    log, flown = adaptive_flight(preset, policy, 2.4, schedule=BRISK)
    plant = Scenario("simple").make("large")
    base = ControllerPilot(PolicyController(build.task(preset).observation, policy))
    plain = fly(plant, base, build.flight_starts(preset, 1)[0], ticks=120)
    swap = next(round(e.t / presets.DT) for e in flown.events if e.kind == "policy")
    np.testing.assert_array_equal(log.u[: swap + 1], plain.u[: swap + 1])
    assert not np.array_equal(log.u[swap + 1], plain.u[swap + 1])


def test_a_busy_learner_is_skipped_not_queued(trained):
    preset, _, policy = trained
    _, flown = adaptive_flight(preset, policy, 2.5, schedule=Schedule(10.0, 0.5, 0.1, 0.7))
    assert [round(e.t, 2) for e in flown.events if e.kind == "skipped"] == [1.0, 2.0]


def test_measured_charge_uses_the_clock(trained):
    preset, _, policy = trained
    _, flown = adaptive_flight(preset, policy, 1.5, schedule=Schedule(0.5, 10.0, None, None))
    (first, *_) = [e.t for e in flown.events if e.kind == "residual"]
    _, slow = adaptive_flight(preset, policy, 1.5, schedule=Schedule(0.5, 10.0, 0.4, None))
    assert first > 0.5
    assert first != next(e.t for e in slow.events if e.kind == "residual")


def test_one_trace_over_many_cycles(trained):
    """New weights, optimiser states, windows and keys never compile again."""
    preset, _, policy = trained
    traces = []

    class Counting(type(build.task(preset))):
        def reward(self, t, x, u):
            traces.append(1)
            return super().reward(t, x, u)

    original = build.task(preset)
    fields = {name: getattr(original, name) for name in original.__dataclass_fields__}
    adapter = eqx.tree_at(lambda a: a.task, build.adapter(preset), Counting(**fields))
    state = adapter.init(policy, build.residual(preset, random.key(2)))
    flying = AdaptivePilot(adapter, state, BRISK, random.key(3), dt=presets.DT, window=preset.adapt.window)
    plant = Scenario("simple").make("large")
    x0 = build.flight_starts(preset, 1)[0]
    fly(plant, flying, x0, ticks=60)
    compiled = len(traces)
    assert compiled > 0
    fly(plant, flying, x0, ticks=250)
    assert sum(e.kind in ("policy", "rejected") for e in flying.events) >= 4
    assert len(traces) == compiled


def test_adaptation_cuts_the_error_under_the_large_disturbance():
    """The whole loop, at reduced size: after three updates at least three times closer than the base policy."""
    preset = presets.changed(
        presets.load("fast"),
        pretrain={"hidden": (64, 64), "epochs": 120, "horizon": 100},
        adapt={"improve_every": 2.0, "refine_every": 1.0, "rate": 3e-3},
    )
    policy = build.policy(preset, random.key(0))
    run = pretrain(
        policy,
        build.nominal(preset),
        build.task(preset),
        random.key(1),
        optimiser=build.optimiser(preset),
        epochs=120,
        envs=16,
        delay=preset.delay,
    )
    *_, (state, _) = run
    x0 = build.flight_starts(preset, 1)[0]
    plant = Scenario("simple").make("large")
    base = fly(plant, ControllerPilot(PolicyController(build.task(preset).observation, state.policy)), x0, ticks=500)
    adapted = fly(plant, pilot(preset, state.policy), x0, ticks=500)
    before, after = (np.linalg.norm(log.p[-50:] - preset.goal, axis=1).mean() for log in (base, adapted))
    assert after < before / 3


def test_a_fit_that_is_not_finite_is_dropped(trained):
    preset, _, policy = trained
    adapter = build.adapter(preset)
    state = adapter.init(policy, build.residual(preset, random.key(2)))
    buffer = RollingBuffer(preset.adapt.window)
    for i in range(10):
        buffer.push(0.0, at(0.0, 0.0, 1.0 + float("nan") * (i == 5)), Command.hover())
    kept, _, sound = adapter.fit_residual(state.residual, buffer.window())
    assert not sound
    jax.tree.map(np.testing.assert_array_equal, kept, state.residual)


def broken_improve(self, s, residual, window, key):
    """An update that went wrong."""
    bad = eqx.tree_at(lambda p: p.layers[0].bias, s.policy, jnp.full_like(s.policy.layers[0].bias, jnp.nan))
    task = self.task
    x0 = jax.vmap(task.reset)(random.split(key, 2))
    return PolicyState(bad, s.optimiser), judge(bad, s.policy, self.nominal, task, x0, delay=self.delay)


def test_a_refused_policy_is_logged_and_never_flies(trained, monkeypatch):
    preset, _, policy = trained
    monkeypatch.setattr(OnlineLearner, "improve", broken_improve)
    log, flown = adaptive_flight(preset, policy, 3.0, schedule=BRISK)
    plant = Scenario("simple").make("large")
    base = ControllerPilot(PolicyController(build.task(preset).observation, policy))
    plain = fly(plant, base, build.flight_starts(preset, 1)[0], ticks=150)
    np.testing.assert_array_equal(log.u, plain.u)
    refused = [e for e in flown.events if e.kind == "rejected"]
    assert [round(e.t, 2) for e in refused] == [1.3, 2.3]
    assert {e.note for e in refused} == {"a weight is not finite"}
    jax.tree.map(np.testing.assert_array_equal, flown.state.policy.policy, policy)


def test_a_second_flight_keeps_what_was_learnt_and_forgets_what_was_seen(trained):
    preset, _, policy = trained
    _, flying = adaptive_flight(preset, policy, 1.5, schedule=BRISK)
    learnt = flying.state
    plant = Scenario("simple").make("large")
    fly(plant, flying, build.flight_starts(preset, 1)[0], ticks=10)
    assert len(flying._buffer) == 10
    jax.tree.map(np.testing.assert_array_equal, flying.state, learnt)


def test_pilot_starts_its_memory_anew_at_time_zero(key):
    task = hover_task(history=2)
    policy = jax.tree.map(lambda leaf: leaf + 0.1, Policy.of(task.observation.size, small(), key=key, hidden=(8,)))
    flying = ControllerPilot(PolicyController(task.observation, policy))
    start = Measurement(0.0, at(0.5, 0.0, 1.0), Command.hover())
    first = flying(start).vector()
    flying(Measurement(0.02, at(0.4, 0.0, 1.0), Command.hover()))
    np.testing.assert_array_equal(flying(start).vector(), first)
