"""Characters of names: what a file calls a preset, a vehicle or a task travels into pictures, pages and C headers."""

import re
from typing import Annotated

from pydantic import AfterValidator

from ..errors import excerpt

MOST = 64
PLAIN = re.compile(rf"[\w./+ -]{{1,{MOST}}}", re.ASCII)
PYTHON = re.compile(r"[\w.]{1,100}:\w{1,64}")
LONGEST = 1024
"""Characters of a path, and of several names that are joined."""


def plain(name: str) -> str:
    """Return a name, unless it has other characters than letters, digits, ``_ . / + -`` and spaces.

    Raises:
        ValueError: It has.
    """
    if not PLAIN.fullmatch(name):
        raise ValueError(f"{excerpt(name)} must be 1 to {MOST} characters: A-Z a-z 0-9 _ . / + - and spaces")
    return name


def plain_or_python(name: str) -> str:
    """Return a plain name or ``module:name``.

    Raises:
        ValueError: It is neither.
    """
    return name if PYTHON.fullmatch(name) else plain(name)


def printable(name: str) -> str:
    """Return a name that may be a path: printable, and not endless.

    Raises:
        ValueError: It is not.
    """
    if not name.isprintable() or not 1 <= len(name) <= LONGEST:
        raise ValueError(f"{excerpt(name)} must be 1 to {LONGEST} printable characters")
    return name


def plain_from(text: str) -> str:
    """Return a plain name that is like a text."""
    return re.sub(r"[^\w./+ -]", ".", text, flags=re.ASCII)[:MOST] or "unnamed"


Plain = Annotated[str, AfterValidator(plain)]
"""Of a preset or a vehicle."""
TaskName = Annotated[str, AfterValidator(plain_or_python)]
Printable = Annotated[str, AfterValidator(printable)]
"""What is looked up: a name, ``module:name``, a path, or several joined by ``+``."""
