"""The gate: what is better is admitted, what is worse or broken is refused, and why."""

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
def trained():
    """The environment of a preset, a fresh policy and one that hovers better."""
    with jax.numpy_dtype_promotion("standard"):
        setup = Setup.from_preset(tiny_preset())
        return setup.env, setup.new_policy(random.key(0)), setup.pretrained(1)


def verdict(candidate, incumbent, env):
    return judge(candidate, incumbent, env, draw_starts(env.task, random.key(5), 4))


def broken(policy):
    return eqx.tree_at(lambda p: p.layers[1].bias, policy, policy.layers[1].bias.at[3].set(jnp.nan))


def test_gate_admits_the_better_and_refuses_the_worse(trained):
    env, fresh, better = trained
    found = verdict(better, fresh, env)
    assert bool(found.admitted)
    assert float(found.candidate) < float(found.incumbent)
    found = verdict(fresh, better, env)
    assert not bool(found.admitted)
    assert "worse than the incumbent" in found.reason()


def test_gate_refuses_nan_by_name(trained):
    env, fresh, _ = trained
    found = verdict(broken(fresh), fresh, env)
    assert not bool(found.admitted)
    assert found.reason() == "a weight is not finite"


def test_gate_admits_an_equal_and_replaces_a_broken_incumbent(trained):
    env, fresh, _ = trained
    assert bool(verdict(fresh, fresh, env).admitted)
    assert bool(verdict(fresh, broken(fresh), env).admitted)
