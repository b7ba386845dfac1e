"""One end of a link, in memory."""

import os
from collections import deque


class Wire:
    """A wire that stores sent data; replies are put into the inbox, immediately if ``answer`` returns some."""

    def __init__(self):
        self.inbox, self.packets, self.answer = deque(), [], lambda data: None
        self._read, self._write = os.pipe()

    def fileno(self):
        return self._read

    def receive(self):
        return self.inbox.popleft() if self.inbox else None

    def send(self, data, to):
        self.packets.append((data, to))
        if (answer := self.answer(data)) is not None:
            self.inbox.append((answer, to))

    def close(self):
        os.close(self._read)
        os.close(self._write)
