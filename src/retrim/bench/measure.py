"""Run each benchmark in its own process, and write a document with all results."""

import json
import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import ConfigError
from ..onboard.launch import PYTHON
from ..runkit.document import Document, TableSection
from ..runkit.reporter import Reporter
from ..runkit.run import Run
from .machine import UNIT_FLOP
from .workloads import WORKLOADS

CORES = ("one", "all") if hasattr(os, "sched_setaffinity") and len(os.sched_getaffinity(0)) > 1 else ("all",)
COLUMNS = (
    "work", "one core, s", "units", "all cores, s", "units", "of the limit", "compile, s", "goal", "paper", "peak, MB",
    "remarks",
)  # fmt: skip
INTRO = """\
Made by `retrim bench`. Each benchmark runs in a separate process, from an empty compile cache unless the row names a
different one; in the columns for one core, the process was restricted to one core. Times are medians. A unit is the
time of this machine, on as many cores and in the same seconds, for 1,000 products of 10 rows with a matrix of 512 x 512
in a scan. Units compare machines where seconds do not. of the limit: the time of the products of an update at the rate
of a unit, as a share of its time. If there is an accelerator, the process for all cores uses it, and the process for
one core does not. paper: reported for an RTX 4090. peak: memory of the process, JAX included."""


def bench(run: Run, reporter: Reporter, *, works: Sequence[str] = tuple(WORKLOADS)) -> bool:
    """Run benchmarks and write ``bench.md`` and ``bench.json``.

    Returns:
        Whether all benchmarks ran.

    Raises:
        ConfigError: There is no such benchmark.
    """
    if unknown := [name for name in works if name not in WORKLOADS]:
        raise ConfigError(f"no work {', '.join(unknown)}; there are {', '.join(WORKLOADS)}")
    rows, machine, failures = list[dict[str, Any]](), dict[str, dict[str, float]](), False
    with tempfile.TemporaryDirectory() as cache, reporter.progress("bench") as advance:
        # The warm benchmark comes last, because it fills the cache folder in which the others run cold.
        for i, name in enumerate(sorted(works, key=lambda name: name == "programs-warm")):
            advance(i / len(works), WORKLOADS[name].title)
            if WORKLOADS[name].two_cores and "one" not in CORES:
                reporter.say(f"{name}: left out, it needs two cores that a process may choose")
                continue
            try:
                machine = machine or {cores: _process("machine", cores, {}) for cores in CORES}
                if name == "programs-warm" and not any(Path(cache).iterdir()):
                    _measure("programs-cold", Path(cache))
                rows.append(_measure(name, Path(cache)))
            except KeyboardInterrupt:
                run.stop.set()
            except OSError as error:
                failures = True
                reporter.say(f"{name}: {error}")
            if run.interrupted:
                break
    document = Document(run, "bench", "Bench", INTRO, [0], reporter)
    document.add(
        _machine(machine), [{"name": "machine", "cores": cores, **result} for cores, result in machine.items()]
    )
    document.add(TableSection(COLUMNS, tuple(_cells(row) for row in rows), "Works"), rows)
    return not failures


def _machine(machine: dict[str, dict[str, float]]) -> TableSection:
    columns = ("", "product 2048, GFLOP/s", "10 x 512 by 512 x 512 in a scan, GFLOP/s", "memory, GB/s")
    lines = tuple(
        (f"{cores} core" if cores == "one" else f"{cores} cores", *(f"{rate:.1f}" for rate in rates.values()))
        for cores, rates in machine.items()
    )
    return TableSection(columns, lines, "The machine")


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    one = row.get("one_core", {})
    times = (one.get("run_s"), one.get("units"), row["run_s"], row.get("units"))
    best = one if one.get("flop") else row
    limit = f"{100 * best['flop'] / UNIT_FLOP / best['units']:.0f} %" if best.get("flop") else "-"
    cells = _seconds(row["compile_s"]), row["goal"], row["paper"], f"{row['peak_mb']:.0f}", row["remarks"]
    return row["work"], *map(_seconds, times), limit, *cells


def _measure(name: str, cache: Path) -> dict[str, Any]:
    """Run one benchmark in a fresh interpreter, and return its row.

    The folder ``cache`` is empty at first; a benchmark uses it only on request.
    """
    environment = {"RETRIM_COMPILE_CACHE": "0", "TF_CPP_MIN_LOG_LEVEL": "3"}
    if WORKLOADS[name].cached:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
    row = {"name": name, **_process(name, "all", environment)}
    if WORKLOADS[name].one_core and "one" in CORES:
        row["one_core"] = _process(name, "one", environment)
    return row


def _process(name: str, cores: str, environment: dict[str, str]) -> dict[str, Any]:
    """Run a benchmark in a separate process, and return the result that the process prints.

    On one core, the process has no accelerator; otherwise, it does not preallocate memory.
    """
    inheritance = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    inheritance |= {"JAX_PLATFORMS": "cpu"} if cores == "one" else {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    process = subprocess.run(
        [*PYTHON, "retrim.bench.workloads", name, cores],
        env=inheritance | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if process.returncode:
        raise OSError(f"failed: {process.stderr.strip().splitlines()[-1:]}")
    result: dict[str, Any] = json.loads(process.stdout.splitlines()[-1])
    return result


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if value < 10 else f"{value:.1f}"
