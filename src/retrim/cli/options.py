"""Build the help texts of options, with placeholders for types, names from the registries, and no default None."""

import functools
import inspect
import types
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro

PLACEHOLDERS = {Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"}


def join_names(names: Iterable[str]) -> str:
    """Return names separated by commas, for a help text."""
    return ", ".join(names)


def option(text: str, *, optional: bool = False) -> Any:
    """Return the annotation of an option with a help text.

    Args:
        text: Help text.
        optional: Whether the default is None; the help then shows no default.
    """
    more: dict[str, Any] = {"metavar": "TEXT", "help_behavior_hint": ""} if optional else {}
    return tyro.conf.arg(help=text, **more)


def simplify_help(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return a command whose help shows placeholders and no defaults for optional options.

    Args:
        command: Function whose arguments are the options; an optional option has the default None.
    """
    hints = get_type_hints(command, include_extras=True)
    signature = inspect.signature(command)
    parameters = []
    for name, parameter in signature.parameters.items():
        hint = hints.get(name, parameter.annotation)
        if parameter.default is None and _of_hint(hint):
            hint = Annotated[hint, tyro.conf.arg(**_of_hint(hint))]
        parameters.append(parameter.replace(annotation=hint))

    @functools.wraps(command)
    def wrapper(*words: Any, **options: Any) -> Any:
        return command(*words, **options)

    wrapper.__annotations__ = {each.name: each.annotation for each in parameters} | {"return": hints.get("return", Any)}
    vars(wrapper)["__signature__"] = signature.replace(parameters=parameters)
    del wrapper.__wrapped__  # only the wrapper's own signature is used
    return wrapper


def _of_hint(hint: Any) -> dict[str, Any]:
    """Return the settings of an option whose type includes None; for any other type, return an empty dictionary."""
    if get_origin(hint) not in (Union, types.UnionType) or type(None) not in get_args(hint):
        return {}
    rest = [each for each in get_args(hint) if each is not type(None)]
    placeholder = PLACEHOLDERS.get(rest[0]) if len(rest) == 1 else None
    return {} if placeholder is None else {"metavar": placeholder, "help_behavior_hint": ""}
