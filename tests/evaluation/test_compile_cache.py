"""Programs are kept for other processes, and given back before a process has too many memory maps."""

import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from retrim.runkit import compile_cache


@pytest.mark.skipif(not compile_cache.MAPS.exists(), reason="the system does not list memory maps")
def test_programs_are_given_back_above_a_number_of_maps():
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


def test_a_system_without_the_list_keeps_them(monkeypatch, tmp_path):
    monkeypatch.setattr(compile_cache, "MAPS", tmp_path / "none")
    assert not compile_cache.release_programs(0)


@pytest.mark.parametrize("off", ["", "0"])
def test_programs_are_kept_in_the_user_s_cache_unless_it_is_off(off, tmp_path, monkeypatch):
    """And a folder that cannot be made is a warning."""
    message = {}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("RETRIM_COMPILE_CACHE", off)
    config = SimpleNamespace(values={"jax_compilation_cache_dir": None}, update=message.__setitem__)
    monkeypatch.setattr(compile_cache, "jax", SimpleNamespace(config=config, __version__="1.2"))
    result = compile_cache.enable_compile_cache()
    if off:
        assert (result, message) == (None, {})
        return
    assert result == tmp_path / "retrim" / "jax-1.2"
    assert result.is_dir()
    assert message["jax_compilation_cache_dir"] == str(result)
    assert message["jax_persistent_cache_min_compile_time_secs"] == 0.0
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="no compile cache"):
        assert compile_cache.enable_compile_cache() is None
