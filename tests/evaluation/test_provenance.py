"""Provenance in a results file: the command and its duration."""

import importlib.metadata
import json
import shlex
import signal
import subprocess
import sys
import threading

import pytest

import retrim
from retrim.errors import ConfigError
from retrim.runkit import Run, provenance
from retrim.runkit.interrupts import interrupts_only_set
from retrim.runkit.provenance import command_line, versions
from retrim.runkit.stopwatch import Stopwatch


@pytest.mark.parametrize(
    ("words", "rest"),
    [
        ("reproduce plants --out {here}/results --starts 2", "reproduce plants --starts 2"),
        ("demo --out={here}/d --seed=3", "demo --seed=3"),
        ("fly --policy {here}/p --config={here}/a.toml", "fly --policy p --config=a.toml"),
        ("fly --policy runs/h --reference circle", "fly --policy runs/h --reference circle"),
        ("demo --out", "demo"),
    ],
)
def test_no_local_path_is_recorded(words, rest, tmp_path):
    assert command_line(words.format(here=tmp_path).split()) == f"retrim {rest}"


def test_command_line_survives_shell():
    words = ["reproduce", "where_learning_pays", "--columns", "geometric + I", "INDI, wrong by two"]
    assert shlex.split(command_line(words)) == ["retrim", *words]


def test_versions_are_installed_versions():
    result = versions()
    assert {"retrim", "jax", "jaxlib", "equinox", "optax", "numpy", "python"} <= result.keys()
    for name in result.keys() - {"python"}:
        assert importlib.metadata.version(name) == result[name]


def test_nested_compilations_count_once():
    watch = Stopwatch()
    # sorted by their ends, as they arrive
    for start, end in ((1.0, 2.0), (1.5, 2.5), (4.0, 4.5), (3.5, 5.0), (7.0, 8.0)):
        watch.compiled(start, end)
    assert watch.compile_s == pytest.approx(1.5 + 1.5 + 1.0)


def test_run_creates_folder_at_first_write(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["retrim", "demo", "--out", str(tmp_path)])
    run = Run("demo", tmp_path / "a" / "b")
    assert not list(tmp_path.iterdir())
    path = run.write_results([{"x": 1}], seeds=[3], losses=[0.5])
    result = json.loads(path.read_text())
    assert (result["command"], result["rows"], result["seeds"], result["losses"]) == (
        "retrim demo",
        [{"x": 1}],
        [3],
        [0.5],
    )
    assert (result["interrupted"], run.exit_code) == (False, 0)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="file: results cannot be written there"):
        Run("demo", tmp_path / "file")
    folder = tmp_path / "kept"
    folder.mkdir()
    Run("demo", folder)
    assert folder.is_dir()
    assert not list(folder.iterdir())


def test_ctrl_c_is_deferred_until_allowed(tmp_path):
    run = Run("demo", tmp_path / "never")
    with run.interruptible():
        raise KeyboardInterrupt
    assert run.interrupted
    assert run.exit_code == 130
    assert not (tmp_path / "never").exists()
    for number in (signal.SIGINT, signal.SIGTERM):
        stop = threading.Event()
        with interrupts_only_set(stop):
            signal.raise_signal(number)
        assert stop.is_set()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_commit_of_checkout_states_local_changes(monkeypatch):
    status = "status --porcelain -- :/src :/pyproject.toml"
    text = {"rev-parse --short=12 HEAD": "abc", status: ""}

    def run(words, **_):
        calls = " ".join(words[3:])
        root = str(provenance.Path(provenance.__file__).resolve().parents[3])
        if calls == "rev-parse --show-toplevel":
            return subprocess.CompletedProcess(words, 0, stdout=f"{root if 'elsewhere' not in text else '/'}\n")
        return subprocess.CompletedProcess(words, 0, stdout=f"{text[calls]}\n")

    monkeypatch.setattr(provenance.subprocess, "run", run)
    calls = provenance.commit.__wrapped__
    assert calls() == "abc"
    text[status] = " M file"
    assert calls() == "abc-dirty"
    text["elsewhere"] = ""
    assert calls() == "unknown"  # an unrelated checkout around an installed package

    def nothing(*_, **__):
        raise FileNotFoundError("git")

    monkeypatch.setattr(provenance.subprocess, "run", nothing)
    assert calls() == "unknown"


def test_code_digest_depends_on_files_only(tmp_path, monkeypatch):
    """The digest depends on names and contents of files, not on a version, a commit, or Python's cache files."""
    here = tmp_path / "retrim" / "runkit"
    here.mkdir(parents=True)
    monkeypatch.setattr(provenance, "__file__", str(here / "provenance.py"))
    code = provenance.code.__wrapped__
    (here / "one.py").write_text("a = 1\n")
    (tmp_path / "retrim" / "data.toml").write_text("x = 1\n")
    first = code()
    (here / "__pycache__").mkdir()
    (here / "__pycache__" / "one.pyc").write_bytes(b"1")
    (tmp_path / "beside.py").touch()
    assert code() == first
    result = {first}
    for path, text in ((here / "one.py", "a = 2\n"), (tmp_path / "retrim" / "data.toml", "x = 2\n")):
        path.write_text(text)
        result.add(code())
    (here / "one.py").rename(here / "two.py")
    assert len(result | {code()}) == 4


def test_page_states_its_command(monkeypatch):
    monkeypatch.setattr(provenance, "commit", lambda: "abc-dirty")
    assert provenance.describe_code() == "Commit abc-dirty"
    monkeypatch.setattr(provenance, "commit", lambda: "unknown")
    assert provenance.describe_code() == f"retrim {retrim.__version__}, installed, code {provenance.code()}"
