"""Print wrong usage of a command as one line, in place of the parser's box."""

import contextlib
import io
import re
import sys
from collections.abc import Iterator

from ..errors import one_line

WRONG_USAGE = 2  # exit code
EDGE = re.compile(r"^[│|]|[│|]\s*$")
RULE = re.compile(r"[╰+│|\s]*[─-]{5,}[╯+│|\s]*")
ATTEMPTS = re.compile(r"Error parsing (\S+): no type matching .* Got errors: .*- <class '\w+'>: (.*)")


@contextlib.contextmanager
def one_line_usage(command: str) -> Iterator[None]:
    """Replace the box of the command-line parser by one line.

    Args:
        command: Command whose words are parsed, for example ``retrim fly``.
    """
    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output):
            yield
    except SystemExit as end:
        text = output.getvalue()
        if end.code == WRONG_USAGE:
            text = one_line(f"retrim: {usage_text(text)}; `{command} --help` lists the options") + "\n"
        sys.stderr.write(text)
        raise
    sys.stderr.write(output.getvalue())


def usage_text(box: str) -> str:
    """Return the part of a box that follows its title, without the frame."""
    part: list[str] = []
    for line in box.splitlines()[1:]:
        if not RULE.fullmatch(line):
            part += EDGE.sub("", line).split()
        elif part:
            break
    text = ATTEMPTS.sub(r"\1: \2", " ".join(part))
    text = text.removeprefix("Error parsing request: ").removeprefix("Error parsing ").rstrip(".")
    return text or " ".join(box.split())
