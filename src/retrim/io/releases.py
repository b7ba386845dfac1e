"""Determines which release wrote a file, to explain a preset that does not fit."""

import functools
import re
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version

NUMBERS = re.compile(r"(\d{1,6})\.(\d{1,6})(?:\.(\d{1,6}))?[\w.+-]{0,40}", re.ASCII)
UNKNOWN_RELEASE = "0.0"


@functools.cache
def this_release() -> str:
    """Return the version of this package."""
    try:
        return version("retrim")
    except PackageNotFoundError:  # a source tree that is not installed
        return UNKNOWN_RELEASE


def newer_release(header: Mapping[str, str]) -> str | None:
    """Return the version that wrote a file if it is known and newer than this one; otherwise return None.

    Args:
        header: Header of the file.
    """
    release = header.get("version", "")
    theirs, ours = _numbers(release), _numbers(this_release())
    return release if theirs is not None and ours is not None and theirs > ours else None


def _numbers(text: str) -> tuple[int, int, int] | None:
    result = NUMBERS.fullmatch(text)
    return None if result is None else (int(result[1]), int(result[2]), int(result[3] or 0))
