"""Check the characters of names.

The names of presets, vehicles and tasks appear in pictures, pages and C headers.
"""

import re
from typing import Annotated

from pydantic import AfterValidator

from ..errors import excerpt

LONGEST_NAME = 64
PLAIN_NAME = re.compile(rf"[\w./+ -]{{1,{LONGEST_NAME}}}", re.ASCII)
PYTHON = re.compile(r"[\w.]{1,100}:\w{1,64}")
LONGEST = 1024
"""Maximum length of a path, or of several joined names [characters]."""


def plain(name: str) -> str:
    """Return the name if it consists of letters, digits, ``_ . / + -`` and spaces.

    Raises:
        ValueError: The name contains other characters, is empty, or is too long.
    """
    if not PLAIN_NAME.fullmatch(name):
        raise ValueError(f"{excerpt(name)} must be 1 to {LONGEST_NAME} characters: A-Z a-z 0-9 _ . / + - and spaces")
    return name


def plain_or_python(name: str) -> str:
    """Return the name if it is a plain name or ``module:name``.

    Raises:
        ValueError: The name has neither form.
    """
    return name if PYTHON.fullmatch(name) else plain(name)


def printable(name: str) -> str:
    """Return the name or path if it is printable and not too long.

    Raises:
        ValueError: The name is empty, too long, or not printable.
    """
    if not name.isprintable() or not 1 <= len(name) <= LONGEST:
        raise ValueError(f"{excerpt(name)} must be 1 to {LONGEST} printable characters")
    return name


def plain_from(text: str) -> str:
    """Return the text as a plain name, with invalid characters replaced."""
    return re.sub(r"[^\w./+ -]", ".", text, flags=re.ASCII)[:LONGEST_NAME] or "unnamed"


Plain = Annotated[str, AfterValidator(plain)]
"""Name of a preset or a vehicle."""
TaskName = Annotated[str, AfterValidator(plain_or_python)]
Printable = Annotated[str, AfterValidator(printable)]
"""Name to look up: a registered name, ``module:name``, a path, or several of these joined by ``+``."""
