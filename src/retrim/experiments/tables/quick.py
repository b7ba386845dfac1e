"""A quick look at a table: one training seed, two starts, short flights."""

import inspect
from collections.abc import Callable, Mapping
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
    return f"{text}\n    out: Folder of what is made; a new one under runs/ by default."


def looked(make: Callable[..., None], chosen: Mapping[str, Any]) -> tuple[Options, str]:
    """Return the options of a table, and what its documents should say of them.

    Args:
        make: The function that makes it.
        chosen: Options as they were asked; with ``quick`` those that differ from their defaults stay.
    """
    if make.__name__ not in QUICK:
        return dict(chosen), ""
    asked = {name: value for name, value in chosen.items() if name != "quick"}
    if not chosen["quick"]:
        return asked, ""
    defaults = inspect.signature(make).parameters
    left = {name for name, value in asked.items() if value == defaults[name].default}
    return {**asked, **{name: value for name, value in QUICK[make.__name__].items() if name in left}}, REMARK
