"""Short commands compile quickly, if the compiler is known to support the flags."""

import os
import subprocess
import sys

import pytest

from retrim.runkit import compile_flags

EMITTERS, LEVEL = compile_flags.QUICK


@pytest.fixture
def flags_of(monkeypatch):
    """Return a function that gives ``XLA_FLAGS`` after the start of a command."""
    monkeypatch.setattr(compile_flags, "enable_compile_cache", lambda: None)

    def begin(command, flags="", *, jaxlib="0.10.1", plugins=()):
        monkeypatch.setenv("XLA_FLAGS", flags)
        monkeypatch.setattr(compile_flags, "version", lambda name: jaxlib)
        monkeypatch.setattr(compile_flags, "entry_points", lambda group: plugins)
        compile_flags.compile_for(command)
        return os.environ["XLA_FLAGS"].split()

    return begin


def test_short_command_compiles_quickly_and_keeps_user_flags(flags_of):
    assert flags_of("fly") == [EMITTERS, LEVEL]
    assert flags_of("demo", "--xla_dump_to=x") == ["--xla_dump_to=x", EMITTERS, LEVEL]
    assert flags_of("demo", "--xla_backend_optimization_level=3") == ["--xla_backend_optimization_level=3", EMITTERS]


@pytest.mark.parametrize(
    ("command", "about"),
    [(name, {}) for name in compile_flags.LONG_COMMANDS]
    + [("fly", {"jaxlib": "0.11.0"}), ("fly", {"plugins": ("cuda",)})],
)
def test_flags_are_unchanged_for_long_commands_unknown_compilers_and_accelerators(flags_of, command, about):
    assert flags_of(command, "--xla_dump_to=x", **about) == ["--xla_dump_to=x"]


def test_installed_compiler_supports_flags():
    """A compiler without a flag ends the process."""
    code = (
        "from retrim.runkit.compile_flags import compile_for; compile_for('fly')\n"
        "import jax; print(jax.jit(lambda x: x + 1)(2))"
    )
    plain = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run([sys.executable, "-c", code], env=plain, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "3", done.stderr
