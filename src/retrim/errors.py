"""Exceptions that retrim raises, with a common base class. Each message is one line of limited length."""

import functools
import sys
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

LONGEST = 480
"""Maximum length of a message [characters]; invalid input can be megabytes long."""
ELLIPSIS = " ... "


class RetrimError(Exception):
    """Base class of all errors in this package. The message states the mistake and the correct input."""

    def __init__(self, message: str = "") -> None:
        """Build an error; ``message`` becomes a printable line of limited length."""
        super().__init__(one_line(message))


def one_line(text: str, most: int = LONGEST) -> str:
    """Return a text as one printable line, with control characters escaped and the middle of a long text omitted.

    Args:
        text: Any text, even from an untrusted source.
        most: Maximum length of the line [characters].
    """
    if len(text) > 4 * most:  # escaping megabytes is slow
        text = text[: 2 * most] + ELLIPSIS + text[-most:]
    line = printable(" ".join(text.split()))
    if len(line) <= most:
        return line
    tail = most // 3
    return line[: most - tail - len(ELLIPSIS)] + ELLIPSIS + line[-tail:]


def printable(text: str) -> str:
    """Escape the control characters in a text, except line feeds, so that it cannot control a terminal."""
    return "".join(sign if sign.isprintable() or sign == "\n" else ascii(sign)[1:-1] for sign in text)


def excerpt(value: object, most: int = 60, *, quotes: bool = True) -> str:
    """Return a value from a file, quoted, escaped and shortened for a message.

    Args:
        value: Any value.
        most: Maximum length [characters].
        quotes: Whether to put a text in quotation marks.
    """
    text = value[: 4 * most] if isinstance(value, str) else value
    quote = repr(text) if quotes or not isinstance(text, str) else text
    return one_line(quote, most)


class ConfigError(RetrimError, ValueError):
    """A preset, scenario, vehicle, task or reference that does not exist or cannot be used."""


class FrameError(ConfigError):
    """A task, observation or controller that cannot be rotated into a different frame."""


class PlantError(RetrimError, RuntimeError):
    """A plant rejected a request, or is no longer available."""


class JobError(RetrimError, RuntimeError):
    """Work sent to another process failed there, or no process could be reached."""


class MessageError(RetrimError, ValueError):
    """A message that must not be used: it is truncated or damaged, has the wrong kind, or holds non-finite numbers."""


class CheckpointError(RetrimError, ValueError):
    """A policy file or learner-state file that must not be used in flight."""


class LogError(RetrimError, ValueError):
    """A flight log that cannot be read, or whose columns cannot have the meaning stated in the column map."""


class TrainingError(RetrimError, RuntimeError):
    """Training failed because the loss was not a number."""


def exit_on_error(main: Callable[P, R]) -> Callable[P, R]:
    """Make a program end with one line, instead of a traceback, after an error of retrim or of the system.

    Args:
        main: Main function of the program.
    """

    @functools.wraps(main)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return main(*args, **kwargs)
        except (RetrimError, OSError) as error:
            sys.exit(one_line(str(error)))

    return run
