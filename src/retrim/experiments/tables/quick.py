"""A quick look at a table: one training seed, two starts, short flights."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from inspect import Parameter
from pathlib import Path
from typing import Any

Options = dict[str, Any]
FEW: Options = {"seeds": (0,), "starts": 2}
SHORT: Options = {**FEW, "seconds": 12.0}
WITHOUT_SAMPLING = ("base", "geometric-i", "indi", "full")  # MPPI takes longer than all of these together
QUICK: dict[str, Options] = {
    "hover": {**SHORT, "presets": ("hover/retrim",), "datt_steps": 1_000_000},
    "track": {**SHORT, "presets": ("track/retrim",), "datt_steps": 1_000_000},
    "vision": {**SHORT, "presets": ("vision/retrim",), "methods": ("base", "base-do", "indi", "full", "lora")},
    "reversing": {**FEW, "seconds": 35.0},
    "design": {**FEW, "epochs": 20},
    "efficiency": {"presets": ("hover/retrim",), "datt_steps": 1_000_000},
    "transfer": {**SHORT, "methods": WITHOUT_SAMPLING},
    "raptor": {**SHORT, "methods": ("raptor", "indi", "full")},
    "fast": {**FEW, "seconds": 24.0, "references": ("figure8=8",), "methods": WITHOUT_SAMPLING},
    "phase": {**FEW, "seconds": 24.0, "references": ("figure8",)},
    "plants": {**SHORT, "plant": ("bem", "simple")},
    "ablation": {**FEW, "seconds": 14.0},
    "scaling": {"flights": (12, 40), "seconds": 6.0},
    "tuning": {"candidates": 12, "starts": 1, "methods": ("geometric", "geometric-i", "indi")},
}
"""By table: options that are smaller."""
ALONE = ("model", "efficiency", "buses", "tuning", "design", "scaling")
"""Tables that this process makes alone."""
GO_ON = (
    "hover", "track", "phase", "vision", "fast", "transfer", "raptor", "ablation", "reversing", "plants", "everything"
)  # fmt: skip
"""Tables that are made in parts, and whose command goes on where it was killed."""
REMARK = "A quick look, smaller than the table: figures to look at, not to quote."


def options_of(make: Callable[..., None]) -> list[Parameter]:
    """Return the options of a table's command: those of the function that makes it, ``on``, ``quick`` and ``out``.

    Its own are the keyword-only parameters. A function that flies no fleets gets no ``on``; one that has no quick look,
    or one of its own, no ``quick``.
    """
    options = [each for each in inspect.signature(make).parameters.values() if each.kind is Parameter.KEYWORD_ONLY]
    if make.__name__ not in ALONE:
        options.append(Parameter("on", Parameter.KEYWORD_ONLY, default=None, annotation=str | None))
    if make.__name__ in QUICK:
        options.append(Parameter("quick", Parameter.KEYWORD_ONLY, default=False, annotation=bool))
    return [*options, Parameter("out", Parameter.KEYWORD_ONLY, default=None, annotation=Path | None)]


def help_of(make: Callable[..., None]) -> str:
    """Return the docstring of a table's command."""
    text = inspect.getdoc(make) or ""
    if make.__name__ not in ALONE:
        text += "\n    on: tcp://HOST:PORT or tls://HOST:PORT of a Dask scheduler, whose workers train and fly."
    if make.__name__ in QUICK:
        text += (
            "\n    quick: One training seed, two starts, short flights, and less of all else that no option asks for."
        )
    where = "a new one under runs/" if (folder := folder_of(make)) is None else f"{folder}, where the command goes on"
    return f"{text}\n    out: Folder of what is made; {where} by default."


def folder_of(make: Callable[..., None], *, quick: bool = False) -> Path | None:
    """Return the folder of a table that nobody names: always the same where its command goes on; None for a new one."""
    if make.__name__ not in GO_ON:
        return None
    whole = make.__name__ == "everything"  # it has a folder of its own for the quick look
    return Path("runs") / f"reproduce-{'all' if whole else make.__name__}{'-quick' * (quick and not whole)}"


def looked(make: Callable[..., None], chosen: Mapping[str, Any], words: Sequence[str] = ()) -> tuple[Options, str]:
    """Return the options of a table, and what its documents should say of them.

    Args:
        make: The function that makes it.
        chosen: Options as they were asked; with ``quick`` those that differ from their defaults stay.
        words: The command's: an option that they name stays, too.
    """
    if make.__name__ not in QUICK:
        return dict(chosen), ""
    asked = {name: value for name, value in chosen.items() if name != "quick"}
    if not chosen["quick"]:
        return asked, ""
    defaults = inspect.signature(make).parameters
    named = {word.partition("=")[0].removeprefix("--").replace("-", "_") for word in words if word.startswith("--")}
    left = {name for name, value in asked.items() if value == defaults[name].default} - named
    return {**asked, **{name: value for name, value in QUICK[make.__name__].items() if name in left}}, REMARK
