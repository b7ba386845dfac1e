"""Programs are given back before a process has too many memory maps, and come again when they are needed."""

import sys

import jax
import jax.numpy as jnp
import pytest

from retrim.experiments import compile_cache


@pytest.mark.skipif(not compile_cache.MAPS.exists(), reason="the system does not list memory maps")
def test_programs_are_given_back_above_a_number_of_maps():
    traces = []

    @jax.jit
    def doubled(x):
        traces.append(1)
        return 2.0 * x

    doubled(jnp.ones(3))
    assert not compile_cache.release_programs(sys.maxsize)
    doubled(jnp.ones(3))
    assert len(traces) == 1
    assert compile_cache.release_programs(0)
    doubled(jnp.ones(3))
    assert len(traces) == 2


def test_a_system_without_the_list_keeps_them(monkeypatch, tmp_path):
    monkeypatch.setattr(compile_cache, "MAPS", tmp_path / "none")
    assert not compile_cache.release_programs(0)
