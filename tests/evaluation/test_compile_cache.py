"""Compiled programs are cached for other processes, and released before a process has too many memory maps."""

import os
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from retrim.runkit import compile_cache


@pytest.mark.skipif(not compile_cache.MAPS.exists(), reason="the system does not list memory maps")
def test_programs_are_released_above_number_of_maps():
    traces = []

    @jax.jit
    def double(x):
        traces.append(1)
        return 2.0 * x

    double(jnp.ones(3))
    assert not compile_cache.release_programs(sys.maxsize)
    double(jnp.ones(3))
    assert len(traces) == 1
    assert compile_cache.release_programs(0)
    double(jnp.ones(3))
    assert len(traces) == 2


def test_programs_are_kept_without_list_of_maps(monkeypatch, tmp_path):
    monkeypatch.setattr(compile_cache, "MAPS", tmp_path / "none")
    assert not compile_cache.release_programs(0)


@pytest.fixture
def config(monkeypatch):
    """The values that a fresh JAX receives."""
    values = {}
    fresh = SimpleNamespace(values={"jax_compilation_cache_dir": None}, update=values.__setitem__)
    monkeypatch.setattr(compile_cache, "jax", SimpleNamespace(config=fresh, __version__="1.2"))
    monkeypatch.delenv("RETRIM_COMPILE_CACHE", raising=False)
    return values


def test_a_folder_that_cannot_be_written_is_only_read(config, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compile_cache.os, "access", lambda path, mode: mode != os.W_OK)
    assert compile_cache.enable_compile_cache() == tmp_path / "retrim" / "jax-1.2"
    assert config["jax_persistent_cache_min_compile_time_secs"] > 1e9


def test_a_user_without_a_home_compiles_each_time(config, monkeypatch):
    def find_no_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(compile_cache.Path, "home", find_no_home)
    with pytest.warns(UserWarning, match="no compile cache: Could not"):
        assert compile_cache.enable_compile_cache() is None
    assert not config


@pytest.mark.parametrize("off", ["", "0"])
def test_programs_are_cached_unless_cache_is_off(off, config, tmp_path, monkeypatch):
    """If the folder cannot be created, a warning is issued."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("RETRIM_COMPILE_CACHE", off)
    result = compile_cache.enable_compile_cache()
    if off:
        assert (result, config) == (None, {})
        return
    assert result == tmp_path / "retrim" / "jax-1.2"
    assert result.is_dir()
    assert config["jax_compilation_cache_dir"] == str(result)
    assert config["jax_persistent_cache_min_compile_time_secs"] == 0.0
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="no compile cache"):
        assert compile_cache.enable_compile_cache() is None
