"""What every command shares: the folder of a run, what machine it ran on, and results for machines."""

import functools
import json
import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

SCHEMA = "retrim.results/1"
console = Console(highlight=False)


class Stopwatch:
    """Separates compiling (tracing, lowering, XLA, reading the compile cache) from running, from its creation on."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._compiling = list[tuple[float, float]]()  # when, without overlap, in order
        self._lock = threading.Lock()
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event in (
            "/jax/core/compile/jaxpr_trace_duration",
            "/jax/core/compile/jaxpr_to_mlir_module_duration",
            "/jax/core/compile/backend_compile_duration",
        ):
            now = time.perf_counter()
            self.compiled(max(self._began, now - duration_secs), now)

    def compiled(self, start: float, end: float) -> None:
        """Note that something was being compiled; programs traced inside others, or on two threads, count once."""
        with self._lock:
            while self._compiling and self._compiling[-1][1] >= start:
                before = self._compiling.pop()
                start, end = min(start, before[0]), max(end, before[1])
            self._compiling.append((start, end))

    @property
    def compile_s(self) -> float:
        """Seconds so far in which something was being compiled."""
        with self._lock:
            return sum(end - start for start, end in self._compiling)

    @property
    def total_s(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self._began


def enable_compile_cache() -> Path | None:
    """Keep compiled programs in the user's cache folder, unless JAX was told otherwise; returns the folder.

    One folder per version of jax. ``RETRIM_COMPILE_CACHE=0`` switches it off.
    """
    if jax.config.values["jax_compilation_cache_dir"] or os.environ.get("RETRIM_COMPILE_CACHE") == "0":
        return None
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = home / "retrim" / f"jax-{jax.__version__}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        console.print(f"[yellow]no compile cache: {error}[/]")
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    return folder


def run_folder(out: Path | None, command: str) -> Path:
    """``out``, or a fresh folder under ``runs/`` named after the command and the time; made at once."""
    folder = out or Path("runs") / f"{command}-{datetime.now():%Y%m%d-%H%M%S}"
    commit()  # remembered from before the command writes anything into the checkout
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@functools.cache
def commit() -> str:
    """Commit of the checkout that this package lies in, with ``-dirty`` for local changes; or ``unknown``."""
    here = Path(__file__).parent

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(here), *words], capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")) / "src" / "retrim" != here.parent:
            return "unknown"
        return git("rev-parse", "--short=12", "HEAD") + ("-dirty" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def machine() -> str:
    """In words: what computes."""
    name = platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    accelerators = sorted({d.device_kind for d in jax.devices() if d.platform != "cpu"})
    return ", ".join([f"{cores} CPU cores ({name})", *accelerators])


def said(words: Sequence[str]) -> str:
    """The command line, without where its results go, and with names for absolute paths: what another machine needs."""
    kept, words = list[str](), list(words)
    while words:
        option, sign, value = words.pop(0).partition("=")
        if option == "--out":
            words = words if sign else words[1:]
        elif sign:
            kept.append(f"{option}={Path(value).name if Path(value).is_absolute() else value}")
        else:
            kept.append(Path(option).name if Path(option).is_absolute() else option)
    return " ".join(["retrim", *kept])


def write_results(
    folder: Path,
    *,
    seeds: Sequence[int],
    watch: Stopwatch,
    rows: Sequence[dict[str, Any]],
    interrupted: bool = False,
    name: str = "results",
    **more: Any,
) -> Path:
    """``results.json`` (or another ``name``) in ``folder``."""
    results = {
        "schema": SCHEMA,
        "command": said(sys.argv[1:]),
        "commit": commit(),
        "versions": {name: version(name) for name in ("retrim", "jax", "jaxlib", "equinox", "optax", "numpy")}
        | {"python": platform.python_version()},
        "device": machine(),
        "seeds": list(seeds),
        "compile_s": round(watch.compile_s, 3),
        "run_s": round(watch.total_s - watch.compile_s, 3),
        "interrupted": interrupted,
        "rows": list(rows),
        **more,
    }
    path = folder / f"{name}.json"
    path.write_text(json.dumps(results, indent=2) + "\n")
    return path
