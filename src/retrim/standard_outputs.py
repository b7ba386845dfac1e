"""Keep a command alive if its outputs cannot be written: a closed pipe, a full disk, or an encoding with few signs."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO, cast


class RobustOutput:
    """Text output that replaces characters without a code, and goes to the null device after an error of writing."""

    def __init__(self, output: Any, name: str = "") -> None:
        """Wrap an output.

        Args:
            output: Text output to write to.
            name: Name of the output in the line that the standard error shows after the first error; by default, there
                is no such line.
        """
        self._output, self._name = output, name

    def write(self, text: str) -> int:
        """Write a text; return its length."""
        try:
            self._output.write(text)
        except UnicodeEncodeError as error:
            self.write(text.encode(error.encoding, "replace").decode(error.encoding))
        except OSError as error:
            self._abandon(error)
        return len(text)

    def flush(self) -> None:
        """Write the text in the buffer."""
        try:
            self._output.flush()
        except OSError as error:
            self._abandon(error)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the wrapped output."""
        return getattr(self._output, name)

    def _abandon(self, error: OSError) -> None:
        with contextlib.suppress(OSError):  # an output in memory has no descriptor
            discard(self._output.fileno())
        if self._name:
            reason, self._name = f"{self._name} cannot be written ({error.strerror or error})", ""
            print(f"retrim: {reason}; the command continues without it", file=sys.stderr, flush=True)


@contextlib.contextmanager
def tolerate_lost_outputs() -> Iterator[None]:
    """Let a command continue if its standard output or error is closed or full, or lacks codes for characters."""
    before = sys.stdout, sys.stderr
    with open(os.devnull, "w") as nowhere:  # in place of an output that was closed before the start
        sys.stdout = cast(TextIO, RobustOutput(sys.stdout or nowhere, "the standard output"))
        sys.stderr = cast(TextIO, RobustOutput(sys.stderr or nowhere))
        try:
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            sys.stdout, sys.stderr = before


def discard(descriptor: int) -> None:
    """Redirect an open file to the null device.

    Args:
        descriptor: Descriptor of the file.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)
