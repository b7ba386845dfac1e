"""Plant faults in the wiring, one at a time, and report the share that the tests notice.

``make mutants`` draws faults at random (seeded) from config, adapt, runtime and experiments: a comparison turned round,
a number changed, two arguments exchanged, a keyword left out, a condition negated. Each is planted in a copy of the
tree, and the tests of its room run until one fails. A survivor wants a test, or is equivalent to the original.
"""

import argparse
import ast
import copy
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
TESTS = {
    "adapt": ("tests/adapt", "tests/runtime", "tests/control"),
    "runtime": ("tests/runtime", "tests/plants"),
    "config": ("tests/config", "tests/runtime", "tests/io"),
    "experiments": ("tests/experiments", "tests/cli"),
}
SWAPS: dict[type, type] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
TEXT = (ast.JoinedStr, ast.Raise, ast.AnnAssign, ast.arguments)
"""Nodes below which nothing is planted: messages and annotations."""


class Mutant(NamedTuple):
    """One fault."""

    path: Path
    line: int
    what: str
    source: str
    """The whole file with the fault."""


def main() -> None:
    """Run as a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=40, help="faults to plant")
    parser.add_argument("--seed", type=int, default=0, help="seed of their choice")
    parser.add_argument("--rooms", nargs="*", default=list(TESTS), choices=list(TESTS), help="where to plant them")
    parser.add_argument("--timeout", type=float, default=600.0, help="seconds for the tests of one fault")
    parser.add_argument("--out", type=Path, help="file for the results as JSON")
    chosen = parser.parse_args()
    everything = [m for room in chosen.rooms for path in sorted((ROOT / "src/retrim" / room).rglob("*.py"))
                  for m in mutants(path)]  # fmt: skip
    sample = random.Random(chosen.seed).sample(everything, min(chosen.count, len(everything)))
    print(f"{len(sample)} of {len(everything)} possible faults, seed {chosen.seed}", flush=True)
    rows = []
    with tempfile.TemporaryDirectory() as place:
        for i, mutant in enumerate(sample, start=1):
            began = time.monotonic()
            seen = noticed(mutant, Path(place), chosen.timeout)
            rows.append({"file": str(mutant.path.relative_to(ROOT)), "line": mutant.line, "fault": mutant.what,
                         "noticed": seen})  # fmt: skip
            shown = "noticed " if seen else "SURVIVED"
            print(f"{i:3d} {shown} {rows[-1]['file']}:{mutant.line} {mutant.what} ({time.monotonic() - began:.0f} s)",
                  flush=True)  # fmt: skip
            if chosen.out:
                chosen.out.write_text(json.dumps({"seed": chosen.seed, "rows": rows}, indent=2) + "\n")
    share = sum(row["noticed"] for row in rows) / max(1, len(rows))
    print(f"noticed: {100 * share:.0f} % of {len(rows)}")
    sys.exit(share < 0.9)


def noticed(mutant: Mutant, place: Path, timeout: float) -> bool:
    """Plant a fault in a copy of the tree; return whether the tests of its room notice it."""
    tree = place / "tree"
    shutil.rmtree(tree, ignore_errors=True)
    for name in ("src", "tests", "examples"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, tree / name)
    (tree / mutant.path.relative_to(ROOT)).write_text(mutant.source)
    room = mutant.path.relative_to(ROOT / "src/retrim").parts[0]
    environment = {**os.environ, "PYTHONPATH": str(tree / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider", *TESTS[room]]
    try:
        ran = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=timeout, check=False)
    except subprocess.TimeoutExpired:
        return True  # a test run that no longer ends is noticed
    return ran.returncode != 0


def mutants(path: Path) -> Iterator[Mutant]:
    """All faults of one file."""
    tree = ast.parse(path.read_text())
    for node in list(_sites(tree)):
        for what, change in _changes(node):
            planted = copy.deepcopy(tree)
            twin = next(n for a, n in zip(ast.walk(tree), ast.walk(planted), strict=True) if a is node)
            change(twin)
            yield Mutant(path, getattr(node, "lineno", 0), what, ast.unparse(planted))


def _sites(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes where a fault changes what is computed, rather than a text."""
    if isinstance(node, TEXT) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
        return
    yield node
    for child in ast.iter_child_nodes(node):
        if not (isinstance(node, ast.FunctionDef) and child is node.returns):
            yield from _sites(child)


def _changes(node: ast.AST) -> Iterator[tuple[str, object]]:
    """Names of faults at a node, and functions that plant them in its twin."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        new = SWAPS[type(node.ops[0])]
        yield f"{ast.unparse(node)}: {new.__name__}", lambda n: n.ops.__setitem__(0, new())
    if isinstance(node, (ast.BinOp, ast.BoolOp)) and type(node.op) in SWAPS:
        other = SWAPS[type(node.op)]
        yield f"{ast.unparse(node)}: {other.__name__}", lambda n: setattr(n, "op", other())
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield f"not {node.value}", lambda n: setattr(n, "value", not n.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        yield f"{node.value} changed", lambda n: setattr(n, "value", 2 * n.value + 1)
    if isinstance(node, (ast.If, ast.IfExp, ast.While)):
        negate = lambda n: setattr(n, "test", ast.UnaryOp(ast.Not(), n.test))  # noqa: E731
        yield f"not ({ast.unparse(node.test)})", negate
    if isinstance(node, ast.Call):
        for k, keyword in enumerate(node.keywords):
            if keyword.arg is not None:
                yield f"without {keyword.arg}=", lambda n, k=k: n.keywords.pop(k)
        if len(node.args) >= 2 and not any(isinstance(a, ast.Starred) for a in node.args):
            yield f"arguments of {ast.unparse(node.func)} exchanged", lambda n: n.args.insert(0, n.args.pop(1))


if __name__ == "__main__":
    main()
