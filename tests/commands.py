"""Commands of a user: in this process if possible, and in a separate one for Ctrl-C and kills."""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import time

from retrim.cli.console import console
from retrim.cli.main import main

# The policy hovers after seconds of training, and updates take little time.
SMALL = """
[pretrain]
hidden_sizes = [64, 64]
num_updates = 150
[adapt]
num_updates = 3
num_envs = 4
fit_steps = 20
fit_every = 1.0
update_every = 1.5
fit_latency = 0.1
update_latency = 0.3
"""
# Preset of a sweep whose policies need not fly: one size, so that sweeps share their programs.
OVERLAY = """
[overlay.pretrain]
hidden_sizes = [16, 16]
num_updates = 10
num_envs = 4
horizon = 40
[overlay.adapt]
window = 20
num_updates = 2
num_envs = 2
fit_steps = 5
fit_every = 0.4
update_every = 0.6
fit_latency = 0.1
update_latency = 0.2
"""
ENVIRONMENT = {**os.environ, "COLUMNS": "160", "NO_COLOR": "1"}


def retrim(*words, cwd, code=0):
    """Run a command in this process; return its output."""
    out = io.StringIO()
    before, console.width = sys.argv, 160
    end_note = None
    with contextlib.chdir(cwd), contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            main([str(word) for word in words])
        except SystemExit as end:
            end_note = end.code
        finally:
            sys.argv = before
    assert end_note == code, out.getvalue()
    return out.getvalue()


def results(folder, name="results.json"):
    return json.loads((folder / name).read_text())


def start_process(words, cwd, setup=""):
    """Start a command in a separate process that handles Ctrl-C regardless of the test runner."""
    listening = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    listening += "; signal.signal(signal.SIGHUP, signal.SIG_DFL)"
    code = f"{listening}\nfrom retrim.cli.main import main\n{setup}\nmain({[str(word) for word in words]!r})"
    return subprocess.Popen(
        [sys.executable, "-u", "-c", code],
        cwd=cwd,
        env={**ENVIRONMENT, "FORCE_COLOR": "1", "TERM": "xterm"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )


def run_interrupted(words, cwd, *, after, setup="", by=signal.SIGINT):
    """Run; send a signal once the output shows ``after`` or that file exists; return exit code and output."""
    process, output = start_process(words, cwd, setup), b""
    deadline = time.monotonic() + 180
    while time.monotonic() < deadline and process.poll() is None:
        if isinstance(after, bytes):
            output += process.stdout.read1(4096)
        else:
            time.sleep(0.005)
        if after in output if isinstance(after, bytes) else after.exists():
            break
    process.send_signal(by)
    rest, _ = process.communicate(timeout=120)
    return process.returncode, (output + rest).decode()
