"""Compare an exported policy with JAX on 10,000 observations, and measure the time of a step.

The test vectors of each format contain NaN, infinite numbers and numbers that are too large.
"""

import math
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ConfigError
from .c_header import name_of
from .portable import Portable
from .runner import LARGEST, Runner

ROWS = 10_000
STEPS = 2_000  # single observations that are used to measure the time of a step
FLAGS = ("-std=c99", "-O3", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
LONGEST = 300.0  # [s]: time limit of the compiler and of the compiled program
MAIN = """#include <stdio.h>
#include <time.h>
#include "{header}"
int main(void)
{{
    static float o[{rows}][{size}], u[{rows}][4];
    struct timespec a, b;
    if (fread(o, sizeof o, 1, stdin) != 1) return 1;
    clock_gettime(CLOCK_MONOTONIC, &a);
    for (int k = 0; k < {rows}; ++k) {name}_command(o[k], u[k]);
    clock_gettime(CLOCK_MONOTONIC, &b);
    fprintf(stderr, "%.9g %.9g", (double)(b.tv_sec - a.tv_sec) + 1e-9 * (double)(b.tv_nsec - a.tv_nsec),
            (double){name}_check());
    return fwrite(u, sizeof u, 1, stdout) != 1;
}}
"""


@dataclass(frozen=True)
class Parity:
    """The accuracy and speed of an exported policy."""

    by: str
    """Program that ran the policy."""
    worst: float
    """Largest difference from JAX, as a fraction of the command range."""
    step_s: float
    """Time of one step [s]: the median; for C, the mean."""


def check_npz(path: Path, policy: Portable, rows: np.ndarray, commands: np.ndarray) -> Parity | None:
    """Check an NPZ file with the NumPy runner."""
    runner = Runner(path)
    return Parity(
        "NumPy", _worst(policy, runner.command(rows), commands), _time_steps(lambda o: runner.command(o), rows)
    )


def check_onnx(path: Path, policy: Portable, rows: np.ndarray, commands: np.ndarray) -> Parity | None:
    """Check a model with ONNX Runtime; return None if ONNX Runtime is not installed."""
    if find_spec("onnxruntime") is None:
        return None
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    result = session.run(["command"], {"observation": rows})[0]
    spoilt = session.run(["command", "finite"], {"observation": _spoilt(rows)})
    if not np.isnan(spoilt[0]).all() or np.any(spoilt[1]):
        return Parity("ONNX Runtime, for numbers that are not finite,", math.inf, math.inf)
    step = _time_steps(lambda o: session.run(["command"], {"observation": o[None]}), rows)
    return Parity("ONNX Runtime", _worst(policy, np.asarray(result), commands), step)


def check_c(path: Path, policy: Portable, rows: np.ndarray, commands: np.ndarray) -> Parity | None:
    """Compile and check a header; return None if there is no compiler.

    Raises:
        ConfigError: The header does not compile.
    """
    compiler = next((result for name in ("gcc", "cc", "clang") if (result := shutil.which(name))), None)
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        shutil.copy(path, place / "policy.h")
        text = MAIN.format(header="policy.h", rows=len(rows), size=rows.shape[1], name=name_of(path))
        (place / "main.c").write_text("#define _POSIX_C_SOURCE 199309L\n" + text)
        words = [compiler, *FLAGS, "main.c", "-o", "main", "-lm"]
        compilation = subprocess.run(words, cwd=place, capture_output=True, text=True, timeout=LONGEST)
        if compilation.returncode != 0:
            raise ConfigError(f"{path.name}: does not compile: {compilation.stderr[:300]}")
        process = subprocess.run([str(place / "main")], input=rows.tobytes(), capture_output=True, timeout=LONGEST)
    seconds, own = (float(word) for word in process.stderr.split())
    outputs = np.frombuffer(process.stdout, dtype=np.float32).reshape(-1, 4)
    return Parity(Path(compiler).name, max(own, _worst(policy, outputs, commands)), seconds / len(rows))


def _spoilt(rows: np.ndarray) -> np.ndarray:
    """Return copies of the first row with NaN, infinity or the smallest number that is too large, at each index."""
    size = rows.shape[1]
    bad = (math.nan, math.inf, -math.inf, LARGEST)
    return np.array([np.where(np.arange(size) == i, x, rows[0]) for x in bad for i in range(size)], np.float32)


def _worst(policy: Portable, outputs: np.ndarray, commands: np.ndarray) -> float:
    return float(np.max(np.abs(outputs - commands) / (policy.high - policy.low)))


def _time_steps(step: Callable[[np.ndarray], Any], rows: np.ndarray) -> float:
    durations = []
    for row in rows[:STEPS]:
        began = time.perf_counter()
        step(row)
        durations.append(time.perf_counter() - began)
    return float(np.median(durations))
