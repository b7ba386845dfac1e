"""The next start removes a bus whose processes were killed, and keeps all others."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from retrim import MessageError
from retrim.transport.leftovers import clear
from retrim.transport.shared_memory import PREFIX, SharedMemoryBus

MAKE = """
import sys, time
from pathlib import Path
from retrim.transport.shared_memory import SharedMemoryBus

bus = SharedMemoryBus(Path(sys.argv[1])) if sys.argv[1:] else SharedMemoryBus.create({"sample": 4096})
print(bus.folder, flush=True)
time.sleep(60.0)
"""


def start(*words):
    """Start a process that creates or joins a bus; return the process and the folder."""
    process = subprocess.Popen([sys.executable, "-c", MAKE, *map(str, words)], stdout=subprocess.PIPE, text=True)
    return process, Path(process.stdout.readline().strip())


def kill(process):
    process.kill()
    process.wait()
    process.stdout.close()


def test_bus_of_killed_processes_is_removed_at_next_start():
    process, folder = start()
    kill(process)
    assert (folder / "sample").exists()
    setup = SharedMemoryBus.create({"sample": 4096})
    try:
        assert not folder.exists()
        assert setup.folder.exists()
    finally:
        setup.remove()


def test_bus_remains_until_last_process_ends():
    first, folder = start()
    second, _ = start(folder)
    try:
        kill(first)
        assert folder not in clear(folder.parent, PREFIX)
        assert folder.exists()
    finally:
        kill(second)
    until = time.monotonic() + 5.0
    while folder.exists() and time.monotonic() < until:
        clear(folder.parent, PREFIX)
    assert not folder.exists()


def test_foreign_folders_remain(tmp_path):
    (tmp_path / "retrim-without-lock").mkdir()
    (tmp_path / "retrim-file").touch()
    (tmp_path / "other").mkdir()
    (tmp_path / "retrim-link").symlink_to(tmp_path / "other")
    for name in ("retrim-without-lock/topics.json", "other/lock"):
        (tmp_path / name).touch()
    before = sorted(tmp_path.rglob("*"))
    assert clear(tmp_path, PREFIX) == []
    assert sorted(tmp_path.rglob("*")) == before


def test_removed_bus_cannot_be_joined(tmp_path):
    bus = SharedMemoryBus.create({"sample": 4096})
    bus.remove()
    with pytest.raises(MessageError, match="there is no bus"):
        SharedMemoryBus(bus.folder)
