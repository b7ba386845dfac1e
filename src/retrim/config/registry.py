"""Registries, one for each kind of component in an experiment.

A name is looked up among the registered objects, then among the entry points of installed packages. ``module:name`` is
imported from the Python path or the current folder. Names from files and messages are first checked by :mod:`.trust`.
Every object is checked when it is registered or found.
"""

import importlib
import re
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Generic, TypeVar

from ..errors import ConfigError, excerpt
from .trust import CSV_FILE
from .validation import suggestion

T = TypeVar("T")
LIBRARIES = (
    str(Path(__file__).resolve().parents[1]),
    *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    "<",
)
"""Path prefixes of files without user code."""


@dataclass(frozen=True)
class _Place:
    """An object that has not been imported yet."""

    name: str
    """``module:name``."""

    def load(self) -> Any:
        module, _, attribute = self.name.partition(":")
        return getattr(importlib.import_module(module), attribute)


class Registry(Mapping[str, T], Generic[T]):
    """Objects of one kind, by name."""

    def __init__(
        self, kind: str, *, example: str, expected: str = "a function", accepts: Callable[[Any], bool] = callable
    ) -> None:
        """Build an empty registry.

        Args:
            kind: Kind of the objects, in the singular; the group of their entry points is ``retrim.<kind>s``.
            example: Example name of a custom object, for error messages.
            expected: Type of the objects, for error messages.
            accepts: Function that returns whether an object has this type.
        """
        self._kind, self._example, self._expected, self._accepts = kind, example, expected, accepts
        self._objects = dict[str, T | _Place]()

    def register(self, name: str, thing: T) -> T:
        """Add an object under a new name.

        Raises:
            ConfigError: The name is already registered or contains forbidden characters, or the object is of a wrong
                type.
        """
        self._check_name(name)
        self._objects[name] = self._check(name, thing)
        return thing

    def register_place(self, name: str, place: str) -> None:
        """Add an object that is imported when it is first used.

        Args:
            name: New name.
            place: ``module:name`` of the object.

        Raises:
            ConfigError: The name is already registered, or contains forbidden characters.
        """
        self._check_name(name)
        self._objects[name] = _Place(place)

    def find(self, name: str) -> T:
        """Return the object with this name.

        Raises:
            ConfigError: The name is unknown (the message suggests known names), ``module:name`` cannot be imported, or
                the object is of a wrong type.
        """
        if name in self:
            return self[name]
        if ":" in name:
            return self._check(name, self._import(name))
        for entry in self._entries():
            if entry.name == name:
                return self._check(name, entry.load())
        names = (*self, *self.plugins())
        raise ConfigError(f"no {self._kind} {name!r}; {suggestion(name, names)}, or {self._example}")

    def plugins(self) -> tuple[str, ...]:
        """Return the names that installed packages add through entry points."""
        return tuple(entry.name for entry in self._entries())

    def _entries(self) -> Iterator[Any]:
        yield from entry_points(group=f"retrim.{self._kind}s")

    def _check_name(self, name: str) -> None:
        if not name or any(sign in name for sign in ":+= \t\n"):
            raise ConfigError(f"{self._kind} name {name!r} must not be empty nor contain ':', '+', '=' or spaces")
        if name in self:
            raise ConfigError(f"{self._kind} {name!r} is already registered")

    def _check(self, name: str, thing: Any) -> T:
        if not self._accepts(thing):
            raise ConfigError(f"{self._kind} {name!r} is a {type(thing).__name__}, not {self._expected}")
        result: T = thing
        return result

    def _import(self, name: str) -> Any:
        module, _, attribute = name.partition(":")
        is_python_name = all(part.isidentifier() for part in module.split(".")) and attribute.isidentifier()
        # Files from strangers may name a trajectory file, so such a name must not import a module of the same name.
        if not is_python_name or CSV_FILE.fullmatch(name):
            known = suggestion(module, tuple(self))
            raise ConfigError(f"no {self._kind} {excerpt(name)}; {known}; a Python name has the form module:name")
        here = str(Path.cwd())
        if here not in sys.path:
            sys.path.append(here)
        try:
            return getattr(importlib.import_module(module), attribute)
        except (Exception, SystemExit) as error:  # a user's module can raise any exception
            raise ConfigError(f"{self._kind} {name!r} cannot be imported: {type(error).__name__}: {error}") from error

    def __getitem__(self, name: str) -> T:
        """Return the object that is registered under ``name``."""
        thing = self._objects[name]
        if isinstance(thing, _Place):
            thing = self._objects[name] = self._check(name, thing.load())
        return thing

    def __contains__(self, name: object) -> bool:
        """Return whether there is a registered object with this name, without importing it."""
        return name in self._objects

    def __iter__(self) -> Iterator[str]:
        """Iterate over the registered names, without importing the objects."""
        return iter(self._objects)

    def __len__(self) -> int:
        """Return the number of registered names."""
        return len(self._objects)


def describe_user_error(error: Exception, words: Sequence[str]) -> str | None:
    """Return a one-line message for an error that involves a user's module, or None for any other error.

    The module's author needs to see the mistake, not retrim's stack trace.

    Args:
        error: Exception that was raised.
        words: Words of the command line; a word with ``module:name`` names such a module.
    """
    here, has_module = str(Path.cwd()), any(_names_a_module(word) for word in words)
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(LIBRARIES)]
    own = [frame for frame in frames if has_module or frame.filename.startswith(here)]
    if not own and not has_module:
        return None
    place = f"{own[-1].filename}, line {own[-1].lineno}: " if own else ""
    hint = "--traceback shows where; retrim.testing.check_... names a broken law"
    return f"{place}{type(error).__name__}: {error}; {hint}"


def _names_a_module(word: str) -> bool:
    """Return whether a word contains ``module:name``; ``file.csv:once`` does not count."""
    return re.search(r"(^|[=+])[A-Za-z_][\w.]*(?<!\.csv):[A-Za-z_]\w*", word) is not None
