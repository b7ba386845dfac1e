"""The house rules that a machine can check: layers, docstrings, sizes, no addresses in the pins."""

import ast
import importlib
import inspect
import re
from pathlib import Path

import pytest
from importlinter import cli as importlinter

import retrim

ROOT = Path(__file__).parent.parent
SOURCES = sorted((ROOT / "src" / "retrim").rglob("*.py"))


def test_layers(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert importlinter.lint_imports(config_filename="pyproject.toml") == 0


FOLDERS = ("physics", "tasks", "control", "learn", "adapt")


@pytest.mark.parametrize("package", ["retrim", *(f"retrim.{name}" for name in FOLDERS)])
def test_public_names_have_docstrings(package):
    module = importlib.import_module(package)
    for name, thing in vars(module).items():
        if not name.startswith("_") and (inspect.isclass(thing) or inspect.isfunction(thing)):
            assert inspect.getdoc(thing), f"{package}.{name} has no docstring"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_are_small_and_have_no_junk_drawers(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 300
    assert path.stem not in {"utils", "common", "helpers", "misc"}
    assert ast.get_docstring(ast.parse(text)) or not text.strip()


def test_only_viz_imports_matplotlib():
    importers = {p for p in SOURCES if re.search(r"^\s*(import|from) matplotlib", p.read_text(), re.M)}
    assert {p.parent.name for p in importers} == {"viz"}


def test_pins_hold_names_and_versions_only():
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[^ ]+( ; .+)?", line), line


def test_importing_retrim_starts_no_backend():
    """An array made at import would; in a fresh interpreter, since here one is running already."""
    import subprocess
    import sys

    code = "import retrim, retrim.cli, jax._src.xla_bridge as b; assert not b._backends, b._backends"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert retrim.PRESETS
