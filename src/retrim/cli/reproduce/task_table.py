"""Tables of tasks in the paper's layout: methods down, disturbances across, the paper's own rows beside ours."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ... import build, presets
from ...control.policy import Policy
from ...presets import Preset
from ...testbed import PlantName
from ..flights import Campaign, Flight, Method, Plan
from ..fly import setting_for
from ..pictures import picture
from ..scores import cell, rows
from ..session import Stopwatch, commit, console, machine, write_results
from ..training import nominal_error, train

LEVELS = ("none", "small", "large")
NAMES: dict[str, str] = {"base": "base policy", "full": "adapted, all weights", "lora": "adapted, LoRA"}


@dataclass(frozen=True)
class Block:
    """Flights of one policy, and what the paper has for them: a row per method, a figure per level [m]."""

    title: str
    preset: Preset
    reference: str | None = None
    methods: tuple[Method, ...] = ("base", "full", "lora")
    paper: tuple[tuple[str, tuple[str, str, str]], ...] = ()

    @property
    def stem(self) -> str:
        """Of the name of its picture: no other block of a table has the same."""
        trained_on = self.preset.reference.replace("+", "-") if self.preset.task == "track" else None
        return "_".join(filter(None, (self.preset.name, self.reference, trained_on)))


def table(
    name: str, about: Sequence[str], blocks: Sequence[Block], *, plant: PlantName, seconds: float, starts: int,
    seed: int, folder: Path,
) -> int:  # fmt: skip
    """Train each policy once, fly all blocks, write ``<name>.md``, ``<name>.json`` and a picture per block."""
    watch, trained = Stopwatch(), dict[Preset, tuple[Policy, float]]()
    lines, found, interrupted = list[str](), list[dict[str, Any]](), False
    for block in blocks:
        if block.preset not in trained:
            console.print(f"preset [bold]{block.preset.name}[/]: {block.title}")
            policy, _, interrupted = train(block.preset, seed)
            if interrupted:
                break
            trained[block.preset] = policy, nominal_error(block.preset, policy)
        policy, own = trained[block.preset]
        flights, interrupted = _flown(block, policy, plant, seconds, starts, seed)
        part = rows(flights, task=block.preset.task, setting=setting_for(block.preset, plant))
        found += [
            {**row, "preset": block.preset.name, "reference": block.reference, "block": block.title} for row in part
        ]
        lines += _lines(block, part, own)
        console.print("\n".join(_lines(block, part, own)), markup=False, soft_wrap=True)
        lines += _picture(block, flights, plant, name, folder)
        foot = f"Compiling {watch.compile_s:.0f} s, all else {watch.total_s - watch.compile_s:.0f} s."
        text = [*about, "", f"Commit {commit()}; {machine()}. Plant `{plant}`, seed {seed}, {starts} starts,",
                f"{seconds:g} s each. Learning is charged to flight time, by the preset's fixed figures.", "",
                *lines, foot + (" Interrupted: incomplete." if interrupted else ""), ""]  # fmt: skip
        (folder / f"{name}.md").write_text("\n".join(text))  # after each block: an interruption loses nothing
        write_results(folder, name=name, seeds=[seed], watch=watch, rows=found, interrupted=interrupted)
        if interrupted:
            break
    console.print(f"[bold]{folder / f'{name}.md'}[/]", soft_wrap=True)
    return 130 if interrupted else 0


def _flown(
    block: Block, policy: Policy, plant: PlantName, seconds: float, starts: int, seed: int
) -> tuple[list[Flight], bool]:
    flown = None if block.reference is None else build.reference(block.reference)
    setting = setting_for(block.preset, plant)
    campaign = Campaign(block.preset, policy, setting=setting, seconds=seconds, starts=starts, seed=seed, flown=flown)
    campaign.warm_up(LEVELS, block.methods)
    return campaign.fly([Plan(d, m, i) for d in LEVELS for m in block.methods for i in range(starts)])


def _lines(block: Block, part: list[dict[str, Any]], own: float) -> list[str]:
    by = {(row["method"], row["disturbance"]): row for row in part}
    crashed, n = sum(row["crashes"] for row in part), sum(row["n"] for row in part)
    about = f"Preset `{block.preset.name}`; {1000 * own:.0f} mm in its own model. {crashed} of {n} flights crashed."
    lines = [f"## {block.title}", "", about, "", "| | none | small | large |", "|---|---|---|---|"]
    for method in block.methods:
        ours = [by.get((method, level)) for level in LEVELS]
        cells = " | ".join("-" if row is None else cell(row) for row in ours)
        lines.append(f"| **{NAMES[method]}** | {cells} |")
        if any(row is not None and "cross_track_m" in row for row in ours):
            cross = " | ".join(
                "-" if not row or "cross_track_m" not in row else f"{row['cross_track_m']:.3f}" for row in ours
            )
            lines.append(f"| ... cross-track | {cross} |")
    lines += [f"| paper, {who} | {' | '.join(figures)} |" for who, figures in block.paper]
    return [*lines, ""]


def _picture(block: Block, flights: list[Flight], plant: PlantName, name: str, folder: Path) -> list[str]:
    large = [f for f in flights if f.plan.disturbance == "large" and f.plan.method in ("base", "full")]
    if not large:
        return []
    flown = None if block.reference is None else build.reference(block.reference)
    setting = setting_for(block.preset, plant)
    path, _ = picture(large, block.preset, "large", setting, folder, flown, stem=f"{name}_{block.stem}")
    return [f"![large disturbance]({path.name})", ""]


def with_reference(name: str, reference: str) -> Preset:
    """A preset trained on another reference."""
    return presets.changed(presets.load(name), reference=reference)
