"""Automated house rules: layers, docstrings, sizes, imports, and pins without addresses."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest
from importlinter import cli as importlinter

import retrim
from retrim.onboard.launch import PYTHON

ROOT = Path(__file__).parent.parent
HOUSE = ROOT / "src" / "retrim"
SOURCES = sorted(HOUSE.rglob("*.py"))
ROOMS = sorted(folder.name for folder in HOUSE.iterdir() if (folder / "__init__.py").exists())
PACKAGES = sorted({"retrim" + "".join(f".{part}" for part in p.parent.relative_to(HOUSE).parts) for p in SOURCES})


def lines(paths):
    return sum(len(path.read_text().splitlines()) for path in paths)


def test_layers(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert importlinter.lint_imports(config_filename="pyproject.toml") == 0


def test_every_package_is_in_a_layer():
    text = (ROOT / "pyproject.toml").read_text()
    (layers,) = re.findall(r"^layers = (\[.*\])$", text, re.M)
    places = {name.strip() for layer in ast.literal_eval(layers) for name in layer.split("|")}
    independent = {name for name in ROOMS if f'source_modules = ["retrim.{name}"]' in text}
    assert set(ROOMS) <= places | independent


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_have_docstrings(package):
    module = importlib.import_module(package)
    assert inspect.getdoc(module)
    public = [name for name in dir(module) if not name.startswith("_")]
    for thing in (getattr(module, name) for name in public):
        if (inspect.isclass(thing) or inspect.isfunction(thing)) and thing.__module__.startswith("retrim"):
            assert inspect.getdoc(thing), f"{package}: {thing.__name__} has no docstring"
            methods = vars(thing).items() if inspect.isclass(thing) else ()
            for name, method in methods:
                if inspect.isfunction(method) and not name.startswith("_"):
                    assert inspect.getdoc(method), f"{package}: {thing.__name__}.{name} has no docstring"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_are_small_and_not_named_utils(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 300
    assert path.stem not in {"utils", "common", "helpers", "misc"}
    assert ast.get_docstring(ast.parse(text)) or not text.strip()


CHANGING = {"runkit.Document", "live.FleetProcess", "live.Status", "live.Supervisor", "onboard.Fallback",
            "onboard.GeometricHover", "onboard.RollbackMonitor"}  # fmt: skip
"""Mutable dataclasses: pages, supervisors of processes, and onboard controllers without JAX."""


def test_values_are_frozen():
    """Dataclasses are frozen except for those with state; an ``equinox.Module`` is always frozen."""
    for path in SOURCES:
        place = path.relative_to(HOUSE)
        for node in ast.walk(ast.parse(path.read_text())):
            for how in getattr(node, "decorator_list", ()):
                is_dataclass = re.match(r"(dataclasses\.)?dataclass\b", ast.unparse(how))
                if is_dataclass and f"{place.parts[0]}.{node.name}" not in CHANGING:
                    assert "frozen=True" in ast.unparse(how), f"{place}: {node.name}"


@pytest.mark.parametrize("room", ROOMS)
def test_packages_have_limited_size(room):
    mine = lines((HOUSE / room).rglob("*.py"))
    assert mine <= 0.2 * lines(SOURCES)
    assert room != "cli" or mine <= 1200


def test_only_viz_imports_matplotlib():
    importers = {p for p in SOURCES if re.search(r"^\s*(import|from) matplotlib", p.read_text(), re.M)}
    assert {p.parent.name for p in importers} == {"viz"}


def test_processes_do_not_import_from_current_folder():
    for path in SOURCES:
        assert path.stem == "launch" or '"-m"' not in path.read_text(), path
    assert PYTHON[1:] == ("-P", "-m")


@pytest.mark.parametrize("name", ["constraints.txt", "tools/uv.txt"])
def test_pins_have_only_names_versions_and_hashes(name):
    pins = (ROOT / name).read_text().replace(" \\\n    ", " ").splitlines()
    assert pins
    for line in pins:
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[^ ]+( ; [^#]+?)?( --hash=sha256:[0-9a-f]{64})+", line), line[:200]


def test_tools_of_hosted_checks_are_pinned():
    """A moving tag such as v4 may refer to a different program tomorrow."""
    used = re.findall(r"uses: (\S+)@(\S+)", (ROOT / ".github" / "workflows" / "ci.yml").read_text())
    assert used
    assert not [each for each in used if not re.fullmatch(r"[0-9a-f]{40}|v\d+\.\d+\.\d+", each[1])]
    (expected,) = re.findall(r"^UV_PIN := (\S+)$", (ROOT / "Makefile").read_text(), re.M)
    assert (ROOT / "tools" / "uv.txt").read_text().startswith(f"uv=={expected} ")


def test_every_public_name_resolves():
    assert len(set(retrim.__all__)) == len(retrim.__all__)
    for name in retrim.__all__:
        assert getattr(retrim, name) is not None
    with pytest.raises(AttributeError):
        retrim.no_such_name  # noqa: B018


QUICK_IMPORT = """
import sys
import retrim
from retrim.cli.main import COMMANDS, main

assert "jax" not in sys.modules, "import retrim imports jax"
for words in (["--help"], ["--version"], [], ["fyl"]):
    try:
        main(words)
    except SystemExit as end:
        print(words, end.code)
assert "jax" not in sys.modules, "retrim --help imports jax"
for module in (*(f"cli.{{name}}" for name in COMMANDS), "onboard.control_process", "onboard.watchdog"):
    __import__(f"retrim.{{module}}")
    assert not {{"matplotlib", "scipy"}} & set(sys.modules), f"{{module}} imports packages that it may not need"
for package in {packages!r}:
    __import__(package)
for name in retrim.__all__:
    getattr(retrim, name)
import jax._src.xla_bridge as bridge

assert not bridge._backends, "an array is made at import"
"""


def test_import_and_help_are_fast_and_start_no_backend():
    """The test uses a fresh interpreter, since a backend is already running here."""
    code = QUICK_IMPORT.format(packages=PACKAGES)
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert "['--help'] 0" in process.stdout
    assert "[] 2" in process.stdout
    assert "['fyl'] 2" in process.stdout
    assert "did you mean 'fly'?" in process.stderr
