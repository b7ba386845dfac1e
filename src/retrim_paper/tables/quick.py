"""Defines quick versions of the tables: one training seed, two starts, short flights."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from inspect import Parameter
from pathlib import Path
from typing import Any

Options = dict[str, Any]
FEW_FLIGHTS: Options = {"seeds": (0,), "starts": 2}
SHORT_FLIGHTS: Options = {**FEW_FLIGHTS, "seconds": 12.0}
METHODS_WITHOUT_SAMPLING = ("base", "geometric-i", "indi", "full")  # MPPI takes longer than all of these together
QUICK: dict[str, Options] = {
    "hover": {**SHORT_FLIGHTS, "presets": ("hover/retrim",), "datt_steps": 1_000_000},
    "track": {**SHORT_FLIGHTS, "presets": ("track/retrim",), "datt_steps": 1_000_000},
    "vision": {**SHORT_FLIGHTS, "presets": ("vision/retrim",), "methods": ("base", "base-do", "indi", "full", "lora")},
    "reversing": {**FEW_FLIGHTS, "seconds": 35.0},
    "design": {**FEW_FLIGHTS, "epochs": 20},
    "efficiency": {"presets": ("hover/retrim",), "datt_steps": 1_000_000},
    "transfer": {**SHORT_FLIGHTS, "methods": METHODS_WITHOUT_SAMPLING},
    "raptor": {**SHORT_FLIGHTS, "methods": ("raptor", "indi", "full")},
    "fast": {**FEW_FLIGHTS, "seconds": 24.0, "references": ("figure8=8",), "methods": METHODS_WITHOUT_SAMPLING},
    "phase": {**FEW_FLIGHTS, "seconds": 24.0, "references": ("figure8",)},
    "plants": {**SHORT_FLIGHTS, "plant": ("bem", "simple")},
    "ablation": {**FEW_FLIGHTS, "seconds": 14.0},
    "where_learning_pays": {
        **FEW_FLIGHTS,
        "columns": ("base", "observer", "geometric + I", "INDI", "INDI, wrong by two"),
    },
    "scaling": {"flights": (12, 40), "seconds": 6.0},
    "tuning": {"candidates": 12, "starts": 1, "methods": ("geometric", "geometric-i", "indi")},
}
"""Options for the quick version, by table."""
SMALL_TABLES = ("model", "efficiency", "buses", "tuning", "design", "scaling")
"""Tables that do not use other machines."""
PIECES = (
    "hover", "track", "phase", "vision", "fast", "transfer", "raptor", "ablation", "reversing", "plants", "everything",
    "where_learning_pays",
)  # fmt: skip
"""Tables that are made in parts, so that the same command resumes after a kill."""
REMARK = "A quick look, smaller than the table: figures to look at, not to quote."


def options_of(make: Callable[..., None]) -> list[Parameter]:
    """Return the options of a table's command: those of its function, and ``on``, ``quick`` and ``out``.

    A function's options are its keyword-only parameters. ``on`` is omitted for tables in ``SMALL_TABLES``. ``quick``
    is not added for tables without a quick version, or with their own ``quick`` option.
    """
    options = [each for each in inspect.signature(make).parameters.values() if each.kind is Parameter.KEYWORD_ONLY]
    if make.__name__ not in SMALL_TABLES:
        options.append(Parameter("on", Parameter.KEYWORD_ONLY, default=None, annotation=str | None))
    if make.__name__ in QUICK:
        options.append(Parameter("quick", Parameter.KEYWORD_ONLY, default=False, annotation=bool))
    return [*options, Parameter("out", Parameter.KEYWORD_ONLY, default=None, annotation=Path | None)]


def help_of(make: Callable[..., None]) -> str:
    """Return the docstring for a table's command."""
    text = inspect.getdoc(make) or ""
    if make.__name__ not in SMALL_TABLES:
        text += "\n    on: tcp://HOST:PORT or tls://HOST:PORT of a Dask scheduler, whose workers train and fly."
    if make.__name__ in QUICK:
        text += (
            "\n    quick: One training seed, two starts, short flights, and less of all else that no option asks for."
        )
    where = "a new one under runs/" if (folder := folder_of(make)) is None else f"{folder}, where the command resumes"
    return f"{text}\n    out: Folder of what is made; {where} by default."


def folder_of(make: Callable[..., None], *, quick: bool = False) -> Path | None:
    """Return the default folder of a table; None means a new folder, for commands that do not resume after a kill."""
    if make.__name__ not in PIECES:
        return None
    whole = make.__name__ == "everything"  # it has its own folder for the quick version
    return Path("runs") / f"reproduce-{'all' if whole else make.__name__}{'-quick' * (quick and not whole)}"


def quick_options(
    make: Callable[..., None], options: Mapping[str, Any], words: Sequence[str] = ()
) -> tuple[Options, str]:
    """Return a table's options, and a remark about them for its documents.

    Args:
        make: Function that makes the table.
        options: Command options; ``quick`` does not change those that differ from their defaults.
        words: Words of the command line; ``quick`` does not change the options that they name, either.
    """
    if make.__name__ not in QUICK:
        return dict(options), ""
    request = {name: value for name, value in options.items() if name != "quick"}
    if not options["quick"]:
        return request, ""
    defaults = inspect.signature(make).parameters
    names = {word.partition("=")[0].removeprefix("--").replace("-", "_") for word in words if word.startswith("--")}
    left = {name for name, value in request.items() if value == defaults[name].default} - names
    return {**request, **{name: value for name, value in QUICK[make.__name__].items() if name in left}}, REMARK
