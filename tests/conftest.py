"""Strict settings: double precision, no silent promotion of types or ranks; the import hook checks shapes."""

import gc
import os
import signal
import sys
from importlib.metadata import version
from pathlib import Path

# Compilation takes nearly all of the suite's time; half of it is optimisation, which is too slow for short tests. A
# program in one piece needs fewer memory maps. Commands of tests inherit the flags. `make demo` and `make wheel` do not
# use them, like users. jaxlib 0.11 and later end the process for an unknown flag.
os.environ["XLA_FLAGS"] = " ".join(
    dict.fromkeys(
        [
            *os.environ.get("XLA_FLAGS", "").split(),
            "--xla_backend_optimization_level=0",
            "--xla_cpu_parallel_codegen_split_count=1",
            *["--xla_cpu_use_fusion_emitters=false"] * version("jaxlib").startswith(("0.8.", "0.9.", "0.10.")),
        ]
    )
)

from shape_checks import keep_checks  # isort: skip

keep_checks()  # before the definition of these functions

import retrim  # noqa: E402, F401  (before jax: it reduces the log of the compile cache)  # isort: skip
import jax  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

from retrim.runkit.compile_cache import enable_compile_cache, release_programs  # noqa: E402

enable_compile_cache()  # shared by the workers and by the commands that tests start
# Only programs that compile slowly are worth a file; test workers do not write thousands of small ones.
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.03)
# A background process of a shell ignores Ctrl-C; tests need it.
signal.signal(signal.SIGINT, signal.default_int_handler)
gc.set_threshold(100_000, 20, 100)  # the default takes several per cent of the time
settings.register_profile("repeatable", derandomize=True)  # the same examples on every machine
settings.load_profile("repeatable")


LONG = ("test_examples.py", "test_extensions.py", "cli/", "docs/", "live/", "evaluation/", "paper/", "estimation/")
"""Files with whole flights: they begin first, so that both workers end at about the same time."""


def pytest_collection_modifyitems(config, items):
    if any("::" in argument for argument in config.args):  # an explicit list of tests keeps its order
        return

    def place(item):
        path = item.path.relative_to(Path(__file__).parent).as_posix()
        return next((i for i, start in enumerate(LONG) if path.startswith(start)), len(LONG))

    items.sort(key=place)


@pytest.fixture(autouse=True)
def forget_lowered():
    """Free the sources of compiled programs: with thousands of them in memory, compilation takes twice as long.

    The compiled programs remain. JAX has no public name for this; if its private names change, this has no effect.
    """
    yield
    for module, name in (("jax._src.pjit", "_pjit_lower"), ("jax._src.interpreters.pxla", "_cached_lowering_to_hlo")):
        cache = getattr(sys.modules.get(module), name, None)
        if cache is not None:
            cache.cache_clear()


@pytest.fixture
def optax_promotion():
    """Permit promotion for an optimiser: optax multiplies Python floats by integer counters."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="module", autouse=True)
def keep_programs():
    """Share compiled programs between files, but free them before they are too many.

    The garbage collector does not visit the remaining objects again.
    """
    yield
    if release_programs():
        gc.unfreeze()
    gc.collect()
    gc.freeze()


@pytest.fixture
def key():
    return jax.random.key(0)


@pytest.fixture(scope="module")
def as_a_user():
    """Use the settings of a user: single precision and the default promotion of JAX, also in threads."""
    from retrim.evaluation.jobs import setup_for

    def configure(values):
        for name, value in values.items():
            jax.config.update(name, value)
        setup_for.cache_clear()  # it holds arrays

    user = {"jax_enable_x64": False, "jax_numpy_dtype_promotion": "standard", "jax_numpy_rank_promotion": "allow"}
    before = {name: jax.config.values[name] for name in user}
    configure(user)
    yield
    configure(before)
