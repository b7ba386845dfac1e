"""Training that diverges ends with one line and saves no policy."""

import sys

import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from commands import retrim
from helpers import tiny_preset
from retrim.config import Setup
from retrim.errors import TrainingError
from retrim.learn.pretrain import pretrain


@pytest.fixture
def losses(monkeypatch):
    """Replace training by a given sequence of losses."""

    def capture(values):
        rest = iter(values)
        monkeypatch.setattr(
            sys.modules[pretrain.__module__],
            "train_chunk",
            lambda state, env, key, optimiser, n, envs: (state, jnp.array([next(rest)] * n)),
        )

    return capture


def run(num_updates, chunk):
    setup = Setup.from_preset(tiny_preset())
    sizes = {"num_updates": num_updates, "num_envs": 2, "chunk": chunk}
    policy = setup.new_policy(random.key(0))
    return len(list(pretrain(policy, setup.env, random.key(1), optimiser=setup.optimiser, **sizes)))


def test_ten_steps_without_finite_loss_end_training(losses):
    losses([1.0, np.nan, 0.5])
    with pytest.raises(TrainingError, match=r"not a number in steps 11 to 20 of 30, and no policy is kept"):
        run(30, 10)


def test_last_step_without_finite_loss_ends_training(losses):
    losses([1.0, 1.0, np.inf])
    with pytest.raises(TrainingError, match=r"in steps 3 to 3 of 3"):
        run(3, 1)


def test_bad_start_is_excluded(losses):
    losses([1.0, np.nan, 0.5, np.inf, 0.4])
    assert run(5, 1) == 5


NAN = """
import jax.numpy as jnp
from retrim.tasks.hover import L2Hover


class Empty(L2Hover):
    def reward(self, t, x, u):
        return jnp.nan * jnp.sum(x.p)


def empty(request):
    o = request.state_observation()
    p = request.preset
    return Empty(jnp.array(p.goal), o, jnp.array(5.0), jnp.array(1.0), p.dt, 5)
"""


@pytest.mark.usefixtures("as_a_user")
def test_diverged_training_saves_nothing(tmp_path):
    (tmp_path / "nan_task.py").write_text(NAN)
    words = ("pretrain", "nan_task:empty", "--updates", "10", "--envs", "1", "--out", "p")
    text = [line for line in retrim(*words, cwd=tmp_path, code=1).splitlines() if line.startswith("retrim:")]
    assert len(text) == 1
    assert "the loss is not a number in steps 1 to 10 of 10, and no policy is kept" in text[0]
    assert not list(tmp_path.rglob("policy.safetensors"))
