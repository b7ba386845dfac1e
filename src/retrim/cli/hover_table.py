"""Table I of the paper, for the base policy and full adaptation: hover under no, small and large disturbance."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from ..control.policy import Policy
from ..presets import Preset
from ..testbed import Setting
from .flights import Campaign, Flight, Method, Plan
from .scores import cell, rows

LEVELS = ("none", "small", "large")
METHODS: tuple[Method, ...] = ("base", "full")
NAMES = {"base": "base policy", "full": "adapted in flight"}
PAPER = {  # Table I [m]
    "base": {"none": "0.128 ± 0.004", "small": "0.328 ± 0.001", "large": "1.228 ± 0.073"},
    "full": {"none": "0.015 ± 0.001", "small": "0.008 ± 0.002", "large": "0.105 ± 0.007"},
}


def fly_table(
    preset: Preset, policy: Policy, setting: Setting, *, seconds: float, starts: int, seed: int
) -> tuple[list[Flight], bool]:
    """Every flight of the table, and whether Ctrl-C cut them short."""
    campaign = Campaign(preset, policy, setting=setting, seconds=seconds, starts=starts, seed=seed)
    campaign.warm_up(LEVELS)
    return campaign.fly([Plan(level, method, i) for level in LEVELS for method in METHODS for i in range(starts)])


@dataclass(frozen=True)
class HoverTable:
    """The table, for machines and for people."""

    rows: list[dict[str, Any]]
    shown: Table
    lines: list[str]
    """The same as Markdown."""


def hover_table(flights: Sequence[Flight], preset: Preset, setting: Setting) -> HoverTable:
    """From flights to rows; the paper's figures stand beside ours, from its own plant."""
    found = rows(flights, task=preset.task, setting=setting)
    by = {(row["disturbance"], row["method"]): cell(row) for row in found}
    starts = max((row["n"] for row in found), default=0)
    seconds = max((float(f.log.t[-1]) for f in flights), default=0.0)
    shown = Table(
        title=f"steady-state hover error \\[m]: mean ± std over {starts} starts, last 2 s of {seconds:g} s",
        title_style="bold",
    )
    heads = ("", "no disturbance", "small, 0.5 m/s² per axis", "large, 2 m/s² per axis")
    lines = ["| " + " | ".join(heads) + " |", "|---|---|---|---|"]
    for head in heads:
        shown.add_column(head)
    for method in METHODS:
        ours = [by.get((level, method), "-") for level in LEVELS]
        theirs = [PAPER[method][level] for level in LEVELS]
        shown.add_row(f"[bold]{NAMES[method]}[/]", *(f"[bold]{text}[/]" for text in ours))
        shown.add_row("[dim]  paper, on its plant[/]", *(f"[dim]{text}[/]" for text in theirs))
        lines.append("| " + " | ".join([f"**{NAMES[method]}**", *(f"**{text}**" for text in ours)]) + " |")
        lines.append("| " + " | ".join(["paper, on its plant", *theirs]) + " |")
    return HoverTable(found, shown, lines)
