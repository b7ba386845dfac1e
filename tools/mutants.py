"""Plant faults in the wiring, one at a time, and report the share that the tests notice.

``make mutants`` draws faults at random (seeded) from config, adapt, runtime and evaluation: a comparison turned round,
a number changed, two arguments exchanged, a keyword left out, a condition negated. The suite runs once to learn which
tests reach which line. Then each fault is planted in a copy of the tree, and tests run until one fails: those that
reach it, first those of its own room, the quick ones before the slow ones; then the others of its room, since a line of
a compiled program is seen only by the test that compiled it, and a line that runs at import by none. A survivor wants a
test, or is equivalent to the original. Numbers that a module states at its top, as those of the presets, are choices: a
test of them would only repeat them.
"""

import argparse
import ast
import bisect
import copy
import itertools
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

from coverage import CoverageData

ROOT = Path(__file__).parent.parent
PLACE = ROOT / "build" / "mutants"
PAPER = "retrim_paper"
TESTS = {
    "adapt": ("tests/adapt", "tests/runtime", "tests/control", "tests/test_house"),
    "runtime": ("tests/runtime", "tests/plants", "tests/test_house"),
    "config": ("tests/config", "tests/runtime", "tests/io", "tests/plants", "tests/test_house"),
    "evaluation": ("tests/evaluation", "tests/paper", "tests/cli", "tests/test_house"),
    PAPER: ("tests/paper", "tests/cli", "tests/test_house"),
}
REACH, BESIDE = 300.0, 60.0  # [s] of tests that run for one fault: of those that reach it, and of others of its room
SWAPS: dict[type, type] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
TEXT = (ast.JoinedStr, ast.Raise, ast.AnnAssign, ast.arguments)
"""Nodes below which nothing is planted: messages and annotations."""
LOOKS = {"color", "dashed", "marks", "columns", "across"}
"""Keywords of how a picture looks; nothing is planted in their values either."""
QUIET = {"strict", "check", "maxsize", "capture_output"} | LOOKS
"""Keywords that change nothing where the rest is right, or only how a picture looks."""
EITHER_WAY = {"min", "max", "minimum", "maximum"}
"""Functions whose arguments may be exchanged."""


class Mutant(NamedTuple):
    """One fault."""

    path: Path
    statement: int
    """First line of the statement that it is in."""
    line: int
    what: str
    source: str
    """The whole file with the fault."""

    @property
    def name(self) -> str:
        """Path below the root."""
        return self.path.relative_to(ROOT).as_posix()

    @property
    def room(self) -> str:
        """Name of its package."""
        package, room, *_ = self.path.relative_to(ROOT / "src").parts
        return room if package == "retrim" else PAPER


def main() -> None:
    """Run as a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60, help="faults to plant")
    parser.add_argument("--seed", type=int, default=0, help="seed of their choice")
    parser.add_argument("--rooms", nargs="*", default=list(TESTS), choices=list(TESTS), help="where to plant them")
    parser.add_argument("--jobs", type=int, default=2, help="faults that are tried at once")
    parser.add_argument("--again", action="store_true", help="believe what the last run found of who reaches what")
    parser.add_argument("--out", type=Path, default=PLACE / "results.json", help="file for the results")
    chosen = parser.parse_args()
    everything = [m for room in chosen.rooms for path in sorted(folder_of(room).rglob("*.py"))
                  for m in mutants(path)]  # fmt: skip
    sample = random.Random(chosen.seed).sample(everything, min(chosen.count, len(everything)))
    if not chosen.again:
        watch()
    reached = Reached()
    print(f"{len(sample)} of {len(everything)} possible faults, seed {chosen.seed}", flush=True)
    rows = []
    with ThreadPoolExecutor(chosen.jobs) as pool:
        for row in pool.map(partial(tried, reached), sample):
            rows.append(row)
            shown = "noticed " if row["noticed"] else "SURVIVED"
            print(f"{len(rows):3d} {shown} {row['file']}:{row['line']} {row['fault']} "
                  f"({row['tests']} tests, {row['seconds']} s)", flush=True)  # fmt: skip
            chosen.out.write_text(json.dumps({"seed": chosen.seed, "rows": rows}, indent=2) + "\n")
    share = sum(row["noticed"] for row in rows) / max(1, len(rows))
    print(f"noticed: {100 * share:.0f} % of {len(rows)}")
    sys.exit(share < 0.9)


def folder_of(room: str) -> Path:
    """Return the folder of a package."""
    return ROOT / "src" / (PAPER if room == PAPER else f"retrim/{room}")


def watch() -> None:
    """Run the suite once, and write down which test reaches which line, and how long each takes."""
    shutil.rmtree(PLACE, ignore_errors=True)
    PLACE.mkdir(parents=True)
    environment = {**os.environ, "COVERAGE_FILE": str(PLACE / "reached")}
    command = [sys.executable, "-m", "pytest", "-m", "not slow", "--cov=retrim", "--cov=retrim_paper",
               "--cov-context=test", "--cov-report=",
               f"--junitxml={PLACE / 'times.xml'}"]  # fmt: skip
    if subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode > 1:
        raise SystemExit("the suite could not be run")


class Reached:
    """Which tests reach a line, as the suite's run found."""

    def __init__(self) -> None:
        self._data = CoverageData(str(PLACE / "reached"))
        self._data.read()
        self._seconds: dict[str, float] = {}
        for case in ElementTree.parse(PLACE / "times.xml").iter("testcase"):
            file = case.attrib["classname"].replace(".", "/") + ".py"
            if len(case):  # it failed, or was skipped, without any fault
                continue
            self._seconds[f"{file}::{case.attrib['name']}"] = float(case.attrib["time"])

    def tests(self, mutant: Mutant) -> tuple[list[str], float]:
        """Return the tests to run for a fault, and how long they take without it [s]."""
        by_line = self._data.contexts_by_lineno(str(mutant.path))
        contexts = [c for line in range(mutant.statement, mutant.line + 1) for c in by_line.get(line, [])]
        found = {context.partition("|")[0] for context in contexts} & self._seconds.keys()
        room = TESTS[mutant.room] if not found else TESTS[mutant.room][:1]
        beside = [test for test in self._seconds if test.startswith(room) and test not in found]
        near = sorted(found, key=lambda test: (not test.startswith(TESTS[mutant.room][0]), self._seconds[test]))
        tests = self._within(REACH, near) + self._within(
            BESIDE if found else REACH, sorted(beside, key=self._seconds.__getitem__)
        )
        return tests, sum(self._seconds[test] for test in tests)

    def _within(self, seconds: float, tests: list[str]) -> list[str]:
        """Return the first of some tests that take so long together."""
        ends = list(itertools.accumulate(self._seconds[test] for test in tests))
        return tests[: bisect.bisect_right(ends, seconds)]


def tried(reached: Reached, mutant: Mutant) -> dict[str, object]:
    """Run the tests that reach a fault; return the row of the results."""
    began = time.monotonic()
    tests, seconds = reached.tests(mutant)
    seen = noticed(mutant, tests, 120.0 + 5.0 * seconds)
    return {"file": mutant.name, "line": mutant.line, "fault": mutant.what, "noticed": seen, "tests": len(tests),
            "seconds": round(time.monotonic() - began)}  # fmt: skip


def noticed(mutant: Mutant, tests: list[str], timeout: float) -> bool:
    """Plant a fault in a copy of the tree; return whether tests notice it, which take far less than ``timeout`` [s]."""
    with tempfile.TemporaryDirectory(dir=PLACE) as tree:
        return _fails(Path(tree), mutant, tests, timeout)


def _fails(tree: Path, mutant: Mutant, tests: list[str], timeout: float) -> bool:
    for name in ("src", "tests", "examples", "docs"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "CONTRIBUTING.md"):
        shutil.copy(ROOT / name, tree / name)
    (tree / mutant.name).write_text(mutant.source)
    environment = {**os.environ, "PYTHONPATH": str(tree / "src")}
    options = ["-q", "-x", "-n", "0", "-m", "not slow", "-p", "no:cacheprovider", "--timeout", "120"]
    command = [sys.executable, "-m", "pytest", *options, *tests]
    try:
        ran = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=timeout, check=False)
    except subprocess.TimeoutExpired:
        return True  # tests that no longer end are noticed
    if ran.returncode not in (0, 1, 2, 4):  # 4: not even the tests can be imported
        raise SystemExit(f"pytest itself failed with {ran.returncode}: {ran.stderr.decode()[-500:]}")
    return ran.returncode != 0


def mutants(path: Path) -> Iterator[Mutant]:
    """All faults of one file."""
    tree = ast.parse(path.read_text())
    stated = {node for each in tree.body if isinstance(each, ast.Assign) for node in ast.walk(each)}
    for statement, node in list(_sites(tree, 0)):
        for what, change in _changes(node, numbers=node not in stated):
            plants = copy.deepcopy(tree)
            twin = next(n for a, n in zip(ast.walk(tree), ast.walk(plants), strict=True) if a is node)
            change(twin)
            yield Mutant(path, statement, getattr(node, "lineno", 0), what, ast.unparse(plants))


def _sites(node: ast.AST, statement: int) -> Iterator[tuple[int, ast.AST]]:
    """Nodes where a fault changes what is computed, rather than a text, and the first lines of their statements."""
    if isinstance(node, TEXT) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
        return
    if isinstance(node, ast.keyword) and node.arg in LOOKS:
        return
    statement = node.lineno if isinstance(node, ast.stmt) else statement
    yield statement, node
    for child in ast.iter_child_nodes(node):
        if not (isinstance(node, ast.FunctionDef) and child is node.returns):
            yield from _sites(child, statement)


def _changes(node: ast.AST, *, numbers: bool) -> Iterator[tuple[str, object]]:
    """Names of faults at a node, and functions that plant them in its twin."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        new = SWAPS[type(node.ops[0])]
        yield f"{ast.unparse(node)}: {new.__name__}", lambda n: n.ops.__setitem__(0, new())
    if isinstance(node, (ast.BinOp, ast.BoolOp)) and type(node.op) in SWAPS:
        other = SWAPS[type(node.op)]
        yield f"{ast.unparse(node)}: {other.__name__}", lambda n: setattr(n, "op", other())
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield f"not {node.value}", lambda n: setattr(n, "value", not n.value)
    elif numbers and isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        yield f"{node.value} changed", lambda n: setattr(n, "value", 2 * n.value + 1)
    if isinstance(node, (ast.If, ast.IfExp, ast.While)):
        negate = lambda n: setattr(n, "test", ast.UnaryOp(ast.Not(), n.test))  # noqa: E731
        yield f"not ({ast.unparse(node.test)})", negate
    if isinstance(node, ast.Call):
        for k, keyword in enumerate(node.keywords):
            if keyword.arg is not None and keyword.arg not in QUIET:
                yield f"without {keyword.arg}=", lambda n, k=k: n.keywords.pop(k)
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if len(node.args) >= 2 and called not in EITHER_WAY and not any(isinstance(a, ast.Starred) for a in node.args):
            yield f"arguments of {ast.unparse(node.func)} exchanged", lambda n: n.args.insert(0, n.args.pop(1))


if __name__ == "__main__":
    main()
