"""The gate admits better policies, and refuses worse or broken ones with a reason."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jax import random

from helpers import draw_starts, tiny_preset
from retrim.adapt import judge
from retrim.config import Setup

pytestmark = pytest.mark.usefixtures("optax_promotion")


@pytest.fixture(scope="module")
def train_gate_case():
    """Return the environment of a preset, a fresh policy, and a policy that hovers better."""
    with jax.numpy_dtype_promotion("standard"):
        setup = Setup.from_preset(tiny_preset())
        return setup.env, setup.new_policy(random.key(0)), setup.pretrained(1)


def verdict(candidate, incumbent, env):
    return judge(candidate, incumbent, env, draw_starts(env.task, random.key(5), 4))


def break_policy(policy):
    return eqx.tree_at(lambda p: p.layers[1].bias, policy, policy.layers[1].bias.at[3].set(jnp.nan))


def test_gate_admits_better_and_refuses_worse_policy(train_gate_case):
    env, fresh, better = train_gate_case
    result = verdict(better, fresh, env)
    assert bool(result.admitted)
    assert float(result.candidate) < float(result.incumbent)
    result = verdict(fresh, better, env)
    assert not bool(result.admitted)
    assert "worse than the incumbent" in result.reason()


def test_gate_refuses_nan_with_reason(train_gate_case):
    env, fresh, _ = train_gate_case
    result = verdict(break_policy(fresh), fresh, env)
    assert not bool(result.admitted)
    assert result.reason() == "a weight is not finite"


def test_gate_admits_equal_policy_and_replaces_broken_incumbent(train_gate_case):
    env, fresh, _ = train_gate_case
    assert bool(verdict(fresh, fresh, env).admitted)
    assert bool(verdict(fresh, break_policy(fresh), env).admitted)
