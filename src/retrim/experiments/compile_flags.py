"""Flags of the compiler that a long command needs, set before JAX starts."""

import os
from importlib.metadata import version

ONE_PIECE = "--xla_cpu_parallel_codegen_split_count"
TRIED_UP_TO = (0, 10)
"""Newest jaxlib that is known to have the flag: one that does not would refuse to start."""


def compile_in_one_piece() -> None:
    """Have each program compiled as one piece of code, unless ``XLA_FLAGS`` says otherwise.

    By default a program is up to 32 pieces, each with a memory map and a table for unwinding of its own. A command that
    compiles thousands of programs then comes near the limit on maps, and one table in many thousands ends exactly at
    the end of its page, where the C library reads on and the process dies. Compiling takes as long.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    major, minor, *_ = version("jaxlib").split(".")
    if ONE_PIECE not in flags and (int(major), int(minor)) <= TRIED_UP_TO:
        os.environ["XLA_FLAGS"] = f"{flags} {ONE_PIECE}=1".strip()
