"""Plant faults in the source, one at a time, and report the proportion that the tests detect.

``make mutants`` draws faults at random (seeded) from config, adapt, runtime, evaluation and retrim_paper: an inverted
comparison, a different number, two exchanged arguments, an omitted keyword argument, a negated condition. First, the
suite runs once and records the lines that each test executes. Then each fault is planted in a copy of the project, and
tests run until one fails: first those that execute the line, beginning with its package and the fastest tests, then
other tests of its package, because the line of a compiled program is recorded only for the test that compiled it, and
a line that runs at import for no test. A fault that no test detects needs a new test, or does not change the
behaviour. Numbers at the top level of a module are choices; a test of them would only repeat them.
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
FOLDER = ROOT / "build" / "mutants"
PAPER = "retrim_paper"
TESTS = {
    "adapt": ("tests/adapt", "tests/runtime", "tests/control", "tests/test_house"),
    "runtime": ("tests/runtime", "tests/plants", "tests/test_house"),
    "config": ("tests/config", "tests/runtime", "tests/io", "tests/plants", "tests/test_house"),
    "evaluation": ("tests/evaluation", "tests/paper", "tests/cli", "tests/test_house"),
    PAPER: ("tests/paper", "tests/cli", "tests/test_house"),
}
EXECUTING, OTHERS = 300.0, 60.0  # [s], duration of the tests for one fault: those that execute it, and others
SWAPS: dict[type, type] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
TEXT = (ast.JoinedStr, ast.Raise, ast.AnnAssign, ast.arguments)
"""Nodes without faults: messages and annotations."""
APPEARANCE = {"color", "dashed", "marks", "columns", "across"}
"""Keyword arguments for the appearance of a figure; their values have no faults either."""
NO_EFFECT = {"strict", "check", "maxsize", "capture_output"} | APPEARANCE
"""Keyword arguments without an effect on correct programs, or only on the appearance of a figure."""
SYMMETRIC = {"min", "max", "minimum", "maximum"}
"""Functions of symmetric arguments."""


class Mutant(NamedTuple):
    """One fault."""

    path: Path
    statement: int
    """First line of its statement."""
    line: int
    change: str
    source: str
    """Text of the file with the fault."""

    @property
    def name(self) -> str:
        """Path relative to the root of the project."""
        return self.path.relative_to(ROOT).as_posix()

    @property
    def package(self) -> str:
        """Name of its package."""
        top, package, *_ = self.path.relative_to(ROOT / "src").parts
        return package if top == "retrim" else PAPER


def main() -> None:
    """Run as a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60, help="number of faults")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random choice")
    parser.add_argument("--packages", nargs="*", default=list(TESTS), choices=list(TESTS), help="packages with faults")
    parser.add_argument("--jobs", type=int, default=2, help="faults that are tested at the same time")
    parser.add_argument("--again", action="store_true", help="use the lines that the last run recorded")
    parser.add_argument("--out", type=Path, default=FOLDER / "results.json", help="file for the results")
    options = parser.parse_args()
    faults = [m for package in options.packages for path in sorted(package_folder(package).rglob("*.py"))
              for m in find_mutants(path)]  # fmt: skip
    sample = random.Random(options.seed).sample(faults, min(options.count, len(faults)))
    if not options.again:
        record_coverage()
    coverage = Coverage()
    print(f"{len(sample)} of {len(faults)} possible faults, seed {options.seed}", flush=True)
    rows = []
    with ThreadPoolExecutor(options.jobs) as pool:
        for row in pool.map(partial(test_mutant, coverage), sample):
            rows.append(row)
            verdict = "detected" if row["detected"] else "MISSED  "
            print(f"{len(rows):3d} {verdict} {row['file']}:{row['line']} {row['fault']} "
                  f"({row['tests']} tests, {row['seconds']} s)", flush=True)  # fmt: skip
            options.out.write_text(json.dumps({"seed": options.seed, "rows": rows}, indent=2) + "\n")
    proportion = sum(row["detected"] for row in rows) / max(1, len(rows))
    print(f"detected: {100 * proportion:.0f} % of {len(rows)}")
    sys.exit(proportion < 0.9)


def package_folder(package: str) -> Path:
    """Return the folder of a package."""
    return ROOT / "src" / (PAPER if package == PAPER else f"retrim/{package}")


def record_coverage() -> None:
    """Run the suite once; record the lines that each test executes, and its duration."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    environment = {**os.environ, "COVERAGE_FILE": str(FOLDER / "coverage")}
    command = [sys.executable, "-m", "pytest", "-m", "not slow", "--cov=retrim", "--cov=retrim_paper",
               "--cov-context=test", "--cov-report=",
               f"--junitxml={FOLDER / 'times.xml'}"]  # fmt: skip
    if subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode > 1:
        raise SystemExit("The suite did not run.")


class Coverage:
    """Tests that execute a line, from the run of the suite."""

    def __init__(self) -> None:
        self._data = CoverageData(str(FOLDER / "coverage"))
        self._data.read()
        self._seconds: dict[str, float] = {}
        for case in ElementTree.parse(FOLDER / "times.xml").iter("testcase"):
            file = case.attrib["classname"].replace(".", "/") + ".py"
            if len(case):  # it failed or was skipped without a fault
                continue
            self._seconds[f"{file}::{case.attrib['name']}"] = float(case.attrib["time"])

    def tests(self, mutant: Mutant) -> tuple[list[str], float]:
        """Return the tests for a fault, and their duration without it [s]."""
        by_line = self._data.contexts_by_lineno(str(mutant.path))
        contexts = [c for line in range(mutant.statement, mutant.line + 1) for c in by_line.get(line, [])]
        executing = {context.partition("|")[0] for context in contexts} & self._seconds.keys()
        own = TESTS[mutant.package][0]
        folders = (own,) if executing else TESTS[mutant.package]
        others = [test for test in self._seconds if test.startswith(folders) and test not in executing]
        first = sorted(executing, key=lambda test: (not test.startswith(own), self._seconds[test]))
        tests = self._within(EXECUTING, first) + self._within(
            OTHERS if executing else EXECUTING, sorted(others, key=self._seconds.__getitem__)
        )
        return tests, sum(self._seconds[test] for test in tests)

    def _within(self, seconds: float, tests: list[str]) -> list[str]:
        """Return the first tests that together take at most ``seconds``."""
        ends = list(itertools.accumulate(self._seconds[test] for test in tests))
        return tests[: bisect.bisect_right(ends, seconds)]


def test_mutant(coverage: Coverage, mutant: Mutant) -> dict[str, object]:
    """Run the tests for a fault; return its row of the results."""
    start = time.monotonic()
    tests, seconds = coverage.tests(mutant)
    detected = detect(mutant, tests, 120.0 + 5.0 * seconds)
    return {"file": mutant.name, "line": mutant.line, "fault": mutant.change, "detected": detected,
            "tests": len(tests), "seconds": round(time.monotonic() - start)}  # fmt: skip


def detect(mutant: Mutant, tests: list[str], timeout: float) -> bool:
    """Plant a fault in a copy of the project; return true if a test fails, or if the tests exceed ``timeout`` [s]."""
    with tempfile.TemporaryDirectory(dir=FOLDER) as copy_of_project:
        return _fails(Path(copy_of_project), mutant, tests, timeout)


def _fails(project: Path, mutant: Mutant, tests: list[str], timeout: float) -> bool:
    for name in ("src", "tests", "examples", "docs"):
        shutil.copytree(ROOT / name, project / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "CONTRIBUTING.md"):
        shutil.copy(ROOT / name, project / name)
    (project / mutant.name).write_text(mutant.source)
    environment = {**os.environ, "PYTHONPATH": str(project / "src")}
    options = ["-q", "-x", "-n", "0", "-m", "not slow", "-p", "no:cacheprovider", "--timeout", "120"]
    command = [sys.executable, "-m", "pytest", *options, *tests]
    try:
        result = subprocess.run(
            command, cwd=project, env=environment, capture_output=True, timeout=timeout, check=False
        )
    except subprocess.TimeoutExpired:
        return True  # an endless test detects the fault
    if result.returncode not in (0, 1, 2, 4):  # 4: the tests cannot be imported
        raise SystemExit(f"pytest failed with exit status {result.returncode}: {result.stderr.decode()[-500:]}")
    return result.returncode != 0


def find_mutants(path: Path) -> Iterator[Mutant]:
    """Return all faults of one file."""
    tree = ast.parse(path.read_text())
    constants = {node for each in tree.body if isinstance(each, ast.Assign) for node in ast.walk(each)}
    for statement, node in list(_sites(tree, 0)):
        for name, plant in _changes(node, numbers=node not in constants):
            mutant = copy.deepcopy(tree)
            twin = next(n for a, n in zip(ast.walk(tree), ast.walk(mutant), strict=True) if a is node)
            plant(twin)
            yield Mutant(path, statement, getattr(node, "lineno", 0), name, ast.unparse(mutant))


def _sites(node: ast.AST, statement: int) -> Iterator[tuple[int, ast.AST]]:
    """Return the nodes that affect a computation, not only a text, and the first lines of their statements."""
    if isinstance(node, TEXT) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
        return
    if isinstance(node, ast.keyword) and node.arg in APPEARANCE:
        return
    statement = node.lineno if isinstance(node, ast.stmt) else statement
    yield statement, node
    for child in ast.iter_child_nodes(node):
        if not (isinstance(node, ast.FunctionDef) and child is node.returns):
            yield from _sites(child, statement)


def _changes(node: ast.AST, *, numbers: bool) -> Iterator[tuple[str, object]]:
    """Return names of faults at a node, and functions that plant them in the copy of the node."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        new = SWAPS[type(node.ops[0])]
        yield f"{ast.unparse(node)}: {new.__name__}", lambda n: n.ops.__setitem__(0, new())
    if isinstance(node, (ast.BinOp, ast.BoolOp)) and type(node.op) in SWAPS:
        other = SWAPS[type(node.op)]
        yield f"{ast.unparse(node)}: {other.__name__}", lambda n: setattr(n, "op", other())
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield f"not {node.value}", lambda n: setattr(n, "value", not n.value)
    elif numbers and isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        yield f"{node.value}: {2 * node.value + 1}", lambda n: setattr(n, "value", 2 * n.value + 1)
    if isinstance(node, (ast.If, ast.IfExp, ast.While)):
        negate = lambda n: setattr(n, "test", ast.UnaryOp(ast.Not(), n.test))  # noqa: E731
        yield f"not ({ast.unparse(node.test)})", negate
    if isinstance(node, ast.Call):
        for k, keyword in enumerate(node.keywords):
            if keyword.arg is not None and keyword.arg not in NO_EFFECT:
                yield f"without {keyword.arg}=", lambda n, k=k: n.keywords.pop(k)
        function = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if len(node.args) >= 2 and function not in SYMMETRIC and not any(isinstance(a, ast.Starred) for a in node.args):
            yield f"arguments of {ast.unparse(node.func)} exchanged", lambda n: n.args.insert(0, n.args.pop(1))


if __name__ == "__main__":
    main()
