"""Ctrl-C, SIGTERM and a closed terminal end a command in the same way, and finished work is saved."""

import os
import pty
import signal
import subprocess
import sys
import threading
import time

import pytest

from retrim.signals import handle_signals, stop_on_signal

WORK = """
import signal, sys, threading, time
from pathlib import Path
from retrim.signals import handle_signals, stop_on_signal

for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # the runner of the tests may ignore them
    signal.signal(number, signal.SIG_DFL)
stop, out = threading.Event(), Path(sys.argv[1])
with stop_on_signal(stop):
    try:
        out.with_suffix(".begun").touch()
        time.sleep(60.0)
    except KeyboardInterrupt:
        with handle_signals(lambda *_: stop.set()):
            print("nobody may read this line", flush=True)
            out.write_text(f"kept, {stop.is_set()}")
"""


def begin(path):
    until = time.monotonic() + 60.0
    while not path.with_suffix(".begun").exists() and time.monotonic() < until:
        time.sleep(0.01)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_each_signal_stops_and_raises(number):
    before, stop = signal.signal(number, signal.SIG_DFL), threading.Event()
    try:
        with pytest.raises(KeyboardInterrupt), stop_on_signal(stop):
            signal.raise_signal(number)
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, before)
    assert stop.is_set()


def test_closed_terminal_saves_finished_work(tmp_path):
    out, (ours, theirs) = tmp_path / "out", pty.openpty()
    words = [sys.executable, "-c", WORK, str(out)]
    process = subprocess.Popen(words, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True)
    os.close(theirs)
    begin(out)
    os.close(ours)  # from now on, writing raises an error
    process.send_signal(signal.SIGHUP)
    assert process.wait(60.0) == 0
    assert out.read_text() == "kept, True"


def test_hangup_ignored_by_nohup_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with handle_signals(lambda *_: pytest.fail("the handler was called")):
            signal.raise_signal(signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
