"""Provide a bus in shared memory for the processes of one machine, without a broker and without blocking.

Each topic is a file that is mapped into memory, with two slots. A writer fills the slot that does not hold the last
message, and then publishes the version. If the writer is killed before publishing, the last message remains intact. A
reader copies a message and compares its version and its checksum. If the writer has published twice in the meantime,
the reader tries again.
"""

import json
import mmap
import os
import shutil
import tempfile
import zlib
from collections.abc import Mapping
from pathlib import Path

from ..errors import MessageError
from .bus import Bus, Message
from .in_process import check_fits, check_topic
from .leftovers import begin, clear, hold

WORD = 8
HEADER = 8 * WORD  # version of the last message; then version, length, checksum of each slot
VERSION, SLOTS = 0, (1, 4)
ATTEMPTS = 100
PLAN = "topics.json"
PREFIX = "retrim-"


class SharedMemoryBus(Bus):
    """One end of the bus. :meth:`create` makes a bus; other processes join it by its folder."""

    def __init__(self, folder: Path) -> None:
        """Join a bus.

        Raises:
            MessageError: There is no bus in ``folder``.
        """
        self.folder = folder
        self._maps: dict[str, tuple[mmap.mmap, memoryview]] = {}
        self._lock: int | None = None
        try:
            self._lock = hold(folder)
            self._capacities: dict[str, int] = json.loads((folder / PLAN).read_text())
            for topic in self._capacities:
                with (folder / topic).open("r+b") as file:
                    memory = mmap.mmap(file.fileno(), 0)
                self._maps[topic] = memory, memoryview(memory)[:HEADER].cast("Q")
        except (OSError, ValueError) as error:
            self.close()
            raise MessageError(f"{folder}: there is no bus ({error})") from error

    @classmethod
    def create(cls, capacities: Mapping[str, int]) -> "SharedMemoryBus":
        """Create a bus in a new folder that only this user can read; :meth:`remove` removes it.

        Leftover buses of killed processes are removed.

        Args:
            capacities: Maximum length of a message, by topic [bytes].

        Raises:
            OSError: There is not enough space for the bus.
        """
        base = Path("/dev/shm") if os.access("/dev/shm", os.W_OK) else Path(tempfile.gettempdir())
        clear(base, PREFIX)
        folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=base))
        try:
            lock = begin(folder)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        try:
            for topic, capacity in capacities.items():
                with (folder / topic).open("wb") as file:  # allocate all now: missing memory in flight raises a signal
                    os.posix_fallocate(file.fileno(), 0, HEADER + 2 * _room(capacity))
            (folder / PLAN).write_text(json.dumps(dict(capacities)))
            return cls(folder)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            os.close(lock)

    def take_in(self, file: Path) -> Path:
        """Copy a file to the folder of the topics, where the copy exists as long as the bus, and return its path.

        Raises:
            OSError: The file cannot be read, or there is not enough space; the bus is then removed.
        """
        try:
            return Path(shutil.copy(file, self.folder / file.name))
        except BaseException:
            self.remove()
            raise

    def publish(self, topic: str, data: bytes) -> None:
        """Replace the last message of ``topic``."""
        check_fits(topic, data, self._capacities)
        memory, words = self._maps[topic]
        version = words[VERSION] + 1
        at, slot = self._slot(topic, version)
        words[slot] = 0  # so that readers do not accept a partly overwritten message
        memory[at : at + len(data)] = data
        words[slot + 1], words[slot + 2] = len(data), zlib.crc32(data)
        words[slot] = version
        words[VERSION] = version

    def latest(self, topic: str, after: int = 0) -> Message | None:
        """Return the last message of ``topic`` if it is newer than ``after``."""
        check_topic(topic, self._capacities)
        memory, words = self._maps[topic]
        for _ in range(ATTEMPTS):
            version = words[VERSION]
            if version <= after:
                return None
            at, slot = self._slot(topic, version)
            length, checksum = words[slot + 1], words[slot + 2]
            if words[slot] == version and length <= self._capacities[topic]:
                data = memory[at : at + length]
                if words[slot] == version and zlib.crc32(data) == checksum:
                    return Message(version, data)
        return None

    def close(self) -> None:
        """Unmap the topics."""
        for memory, words in self._maps.values():
            words.release()
            memory.close()
        self._maps = {}
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def remove(self) -> None:
        """Remove the bus; processes that have joined keep their mappings."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.close()

    def _slot(self, topic: str, version: int) -> tuple[int, int]:
        """Return the offset of the bytes of a version, and the first word of its slot."""
        which = version % 2
        return HEADER + which * _room(self._capacities[topic]), SLOTS[which]


def _room(capacity: int) -> int:
    return -(-capacity // WORD) * WORD
