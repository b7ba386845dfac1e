"""Processes that stand in for an autopilot and its vehicle."""

import contextlib
import subprocess
import sys


@contextlib.contextmanager
def start_process(*command):
    """A process, once it has said that it is there; ended by the signal that Ctrl-C is to it."""
    process = subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, text=True)
    try:
        assert "Ctrl-C ends it" in process.stdout.readline()
        yield process
    finally:
        process.terminate()
        process.wait(10.0)
        process.stdout.close()


def peer(speaks, *words):
    """A peer of ours that speaks the language of an autopilot."""
    module = "retrim.ros1.peer" if speaks == "ros" else f"retrim.testing.{speaks}_peer"
    return start_process(sys.executable, "-m", module, *words)
