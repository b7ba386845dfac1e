"""Processes that simulate an autopilot and a vehicle."""

import contextlib
import subprocess
import sys


@contextlib.contextmanager
def start_process(*command):
    """Start a process and wait for its first output; at the end, interrupt it."""
    process = subprocess.Popen([*map(str, command)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert "Ctrl-C ends it" in process.stdout.readline()
        yield process
    finally:
        process.terminate()
        process.wait(10.0)
        process.stdin.close()
        process.stdout.close()


def start_peer(protocol, *words):
    """Start a peer with the protocol of an autopilot."""
    module = "retrim.ros1.peer" if protocol == "ros" else f"retrim.testing.{protocol}_peer"
    return start_process(sys.executable, "-m", module, *words)
