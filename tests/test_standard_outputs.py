"""A standard output that is closed or full does not end a command, and errors appear on the standard error."""

import contextlib
import importlib
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from retrim.standard_outputs import tolerate_lost_outputs

main = importlib.import_module("retrim.cli.main")  # the package has a function of that name
FULL = Path("/dev/full")
LOST = "retrim: the standard output cannot be written ({}); the command continues without it\n"


def closed_pipe():
    reader, writer = os.pipe()
    os.close(reader)
    return writer


@pytest.mark.parametrize(
    ("descriptor", "reason"),
    [
        (closed_pipe, "Broken pipe"),
        pytest.param(
            lambda: os.open(FULL, os.O_WRONLY),
            "No space left on device",
            marks=pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full"),
        ),
    ],
)
def test_lost_output_is_reported_once_and_does_not_end_work(descriptor, reason):
    errors = io.StringIO()
    with open(descriptor(), "w") as output:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors), tolerate_lost_outputs():
            for _ in range(3):
                print("nobody may read this line", flush=True)
            print("nor this line, which is still in the buffer")
        assert os.fstat(output.fileno()).st_rdev == os.stat(os.devnull).st_rdev  # also for processes started later
    assert errors.getvalue() == LOST.format(reason)


def test_lost_standard_error_is_tolerated_without_a_line(capsys):
    with open(closed_pipe(), "w") as errors, contextlib.redirect_stderr(errors), tolerate_lost_outputs():
        print("nobody may read this line", file=sys.stderr, flush=True)
        print("result")
    assert capsys.readouterr().out == "result\n"


def test_outputs_closed_before_the_start_are_tolerated(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    with tolerate_lost_outputs():
        sys.stdout.write("nobody may read this line")
        sys.stderr.write("nor this line")
    assert (sys.stdout, sys.stderr) == (None, None)


@pytest.mark.parametrize(("words", "code"), [(["--help"], 0), (["--version"], 0), (["fly", "--policy", "none"], 1)])
def test_command_with_lost_output_keeps_its_exit_code(words, code, monkeypatch, capsys):
    with open(closed_pipe(), "w") as output, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", output)
        patch.setattr(sys, "argv", ["retrim"])
        with pytest.raises(SystemExit) as end:
            main.main(words)
    assert end.value.code == code
    refusal = "retrim: none: no such file; `retrim pretrain hover --out DIR` makes one\n"  # nothing else was written
    assert capsys.readouterr().err == (LOST.format("Broken pipe") if code == 0 else refusal)


def test_process_with_closed_pipe_prints_no_traceback():
    words = [sys.executable, "-m", "retrim.cli", "--help"]
    writer = closed_pipe()
    done = subprocess.run(words, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, LOST.format("Broken pipe"))


def test_output_with_few_characters_replaces_others():
    memory = io.BytesIO()
    output = io.TextIOWrapper(memory, encoding="ascii")
    with contextlib.redirect_stdout(output), tolerate_lost_outputs():
        print("1.0 ± 0.2 mm \udcff")
    assert memory.getvalue() == b"1.0 ? 0.2 mm ?\n"
