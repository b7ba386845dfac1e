"""Training with progress, local and remote, and the error of a policy in its own model."""

import threading
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fake_flights import Watching
from helpers import brief_preset, tiny_preset
from retrim import Setup
from retrim.config.loading import changed
from retrim.errors import JobError
from retrim.learn.rollout import rollout
from retrim.runkit import training
from retrim.runkit.reporter import Silent

pytestmark = pytest.mark.usefixtures("as_a_user")


@pytest.fixture(scope="module")
def setup(as_a_user):
    return Setup.from_preset(brief_preset(pretrain={"num_updates": 30}))


def test_progress_is_reported_and_stop_keeps_last_state(setup):
    reporter = Watching()
    whole = training.train(setup, 4, reporter=reporter)
    assert {title for title, *_ in reporter.messages} == {"pretraining, 30 x 2 x 20"}
    assert reporter.shares == pytest.approx([0.0, 1 / 3, 2 / 3, 1.0])
    assert reporter.messages[-1][2] == f"loss {whole.losses[-1]:.3f}"
    assert len(whole.losses) == 30
    stop = threading.Event()
    part = training.train(setup, 4, reporter=Watching(lambda share: share > 0.3 and stop.set()), stop=stop)
    assert part.losses == whole.losses[:10]
    other = training.train(setup, 5, stop=stop)
    assert other.losses != part.losses

    def ctrl_c(share):
        if share > 0.3:
            raise KeyboardInterrupt

    stop.clear()
    cut = training.train(setup, 4, reporter=Watching(ctrl_c), stop=stop)
    assert stop.is_set()
    assert cut.losses == part.losses


def test_model_error_is_over_last_half_second_of_six(setup):
    policy, n = setup.new_policy(jax.random.key(0)), 3
    env = training._long(setup).env
    assert env.task.horizon == 300
    flight = eqx.filter_jit(lambda key: rollout(env, policy, env.task.reset(key)).x.p)
    ends = [np.asarray(flight(key))[-25:] for key in jax.random.split(jax.random.key(7), n)]
    by_hand = np.mean([np.linalg.norm(p - np.array(setup.preset.goal), axis=1).mean() for p in ends])
    result = training.nominal_error(setup, policy, n=n, seed=7)
    assert result == pytest.approx(by_hand, rel=1e-4)
    assert result != training.nominal_error(setup, policy, n=n, seed=8)
    nothing = setup.learner.init(policy, jax.random.key(1)).residual
    residual = training.FittedResidual(setup.learner.residual_model, nothing)
    assert training.model_error(setup, policy, residual, n=n, seed=7) == pytest.approx(result, rel=1e-4)  # no learning


def test_remote_training_is_parallel_and_ordered(setup, monkeypatch):
    calls, on_result, gate = [], [], threading.Barrier(2)

    def job(preset, seed):
        calls.append((preset, seed))
        gate.wait(20.0)  # both run at the same time
        return setup.new_policy(jax.random.key(seed))

    monkeypatch.setattr(training, "train_job", job)
    reporter = Watching()
    with ThreadPoolExecutor(2) as pool:
        result = training.train_elsewhere(
            setup.preset, (5, 2), pool, reporter=reporter, stop=threading.Event(),
            on_result=lambda seed, policy: on_result.append((seed, policy)),
        )  # fmt: skip
    assert {preset for preset, _ in calls} == {training.dump(setup.preset)}
    assert list(result) == [5, 2]
    assert sorted(seed for seed, _ in on_result) == [2, 5]
    assert all(policy is result[seed] for seed, policy in on_result)
    assert reporter.messages[-1][1:] == (1.0, "2 of 2 seeds")


def test_failed_remote_training_is_reported_after_others(setup, monkeypatch):
    on_result, stop = [], threading.Event()

    def job(preset, seed):
        if seed == 1:
            raise OSError("disk\nis full")
        return setup.new_policy(jax.random.key(seed))

    monkeypatch.setattr(training, "train_job", job)
    with ThreadPoolExecutor(1) as pool, pytest.raises(
        JobError, match=f"1 of 3 trainings of {setup.preset.name} failed: seed 1: disk is full"
    ):  # fmt: skip
        training.train_elsewhere(
            setup.preset,
            (1, 0, 3),
            pool,
            reporter=Silent(),
            stop=stop,
            on_result=lambda seed, _: on_result.append(seed),
        )
    assert sorted(on_result) == [0, 3]
    stop.set()
    with ThreadPoolExecutor(1) as pool:
        assert training.train_elsewhere(setup.preset, (0,), pool, reporter=Silent(), stop=stop) == {}


def test_job_trains_its_preset_and_seed(setup, monkeypatch):
    calls = []

    def train(setup, seed):
        calls.append((setup.preset, seed))
        return training.TrainingResult(setup.new_policy(jax.random.key(seed)), [])

    monkeypatch.setattr(training, "train", train)
    policy = training.train_job(training.dump(setup.preset), 6)
    assert calls == [(setup.preset, 6)]
    assert bool(jnp.array_equal(policy.layers[0].weight, setup.new_policy(jax.random.key(6)).layers[0].weight))


@pytest.mark.parametrize(("z", "warned"), [(1.0, False), (0.0, False), (-1.5, True)])
def test_goal_below_ground_is_reported(z, warned):
    setup = Setup.from_preset(changed(tiny_preset(), goal=(0.0, 0.0, z)))
    assert (training.ground_warning(setup) is not None) == warned
    if warned:
        assert "z = -1.5 m, below the ground" in training.ground_warning(setup)
