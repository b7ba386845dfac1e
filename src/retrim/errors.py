"""Every error that retrim raises on purpose, under one root. Each is one line of limited length."""

LONGEST = 480
"""Characters of a message: what was given may be megabytes."""
CUT = " ... "


class RetrimError(Exception):
    """Root of all errors of this package. The message names what was wrong and what would be right."""

    def __init__(self, message: str = "") -> None:
        """Build one; ``message`` becomes a printable line of limited length."""
        super().__init__(one_line(message))


def one_line(text: str, most: int = LONGEST) -> str:
    """Return a text as one printable line: control characters escaped, the middle of a long one left out.

    Args:
        text: Any; it may hold what a stranger wrote.
        most: Characters that are left.
    """
    if len(text) > 4 * most:  # escaping megabytes is slow
        text = text[: 2 * most] + CUT + text[-most:]
    line = printable(" ".join(text.split()))
    if len(line) <= most:
        return line
    tail = most // 3
    return line[: most - tail - len(CUT)] + CUT + line[-tail:]


def printable(text: str) -> str:
    """Return a text whose control characters are escaped, but for the ends of lines: it cannot steer a terminal."""
    return "".join(sign if sign.isprintable() or sign == "\n" else ascii(sign)[1:-1] for sign in text)


def excerpt(value: object, most: int = 60, *, quotes: bool = True) -> str:
    """Return a value of a file as a message may show it: in quotation marks, escaped, and not long.

    Args:
        value: Any.
        most: Characters that are left.
        quotes: Whether a text has quotation marks.
    """
    text = value[: 4 * most] if isinstance(value, str) else value
    shown = repr(text) if quotes or not isinstance(text, str) else text
    return one_line(shown, most)


class ConfigError(RetrimError, ValueError):
    """A preset, scenario, vehicle, task or reference that does not exist or cannot be used."""


class FrameError(ConfigError):
    """A task, observation or controller that cannot be turned into another frame."""


class PlantError(RetrimError, RuntimeError):
    """A plant refused what it was asked for, or it is gone."""


class JobError(RetrimError, RuntimeError):
    """Work that was handed to another process has failed there, or nobody can be reached who would do it."""


class MessageError(RetrimError, ValueError):
    """Bytes that must not be used: truncated, damaged, of another kind, or with values that are not finite."""


class CheckpointError(RetrimError, ValueError):
    """A file with a policy or with what was learnt that must not be flown."""


class LogError(RetrimError, ValueError):
    """A flight log that cannot be read, or whose columns cannot be what the map says that they are."""


class TrainingError(RetrimError, RuntimeError):
    """Training that has come to nothing: its loss is not a number."""
