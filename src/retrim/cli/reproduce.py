"""``retrim reproduce``: tables of the paper, written where the documentation keeps them."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from .. import presets
from .flights import Flight
from .hover_table import fly_table, hover_table
from .pictures import picture
from .session import Stopwatch, commit, console, machine, run_folder, write_results
from .training import nominal_error, train


def reproduce(
    table: tyro.conf.Positional[Literal["hover"]],
    preset: tuple[Literal["fast", "released", "paper"], ...] = ("fast", "released", "paper"),
    seeds: tuple[int, ...] = (0, 1, 2),
    seconds: float = 30.0,
    starts: int = 8,
    out: Path | None = None,
) -> int:
    """Table I: hover under three disturbances, for each preset, over several training seeds.

    Args:
        table: Which table.
        preset: Presets to train and fly.
        seeds: Training seeds; each also seeds the starts and the learners of its flights.
        seconds: Length of a flight.
        starts: Flights per disturbance, method and seed.
        out: Folder for hover.md, hover.json and a picture; a new one under runs/ by default.
    """
    watch = Stopwatch()
    folder = run_folder(out, "reproduce")
    lines = [
        "# Hover (Table I of the paper, base policy and full adaptation)",
        "",
        f"Made by `retrim reproduce {table}`. Steady-state error [m]: mean over the last 2 s of {seconds:g} s; mean ±",
        f"standard deviation over {len(seeds)} training seeds ({', '.join(map(str, seeds))}) x {starts} starts. Plant",
        "`simple`, small quadrotor. Learning is charged to flight time, by the preset's fixed figures. The paper's",
        "rows are from its own, different plant.",
        "",
        f"Commit {commit()}; {machine()}.",
        "",
    ]
    rows, interrupted, pictured = list[dict[str, Any]](), False, list[Path]()
    for name in preset:
        settings = presets.load(name)
        flights: list[Flight] = []
        errors: list[float] = []
        for seed in seeds:
            console.print(f"[bold]{name}[/], seed {seed}")
            policy, _, interrupted = train(settings, seed)
            if interrupted:
                break
            errors.append(nominal_error(settings, policy))
            flown, interrupted = fly_table(settings, policy, seconds=seconds, starts=starts, seed=seed)
            if name == preset[0] and seed == seeds[0]:
                pictured = picture(flown, settings, "large", settings.vehicle, folder) if flown else []
            flights += flown
            if interrupted:
                break
        if not flights:
            break
        found = hover_table(flights, settings)
        rows += [{**row, "preset": name} for row in found.rows]
        console.print(found.shown)
        swaps = [len(f.swaps) for f in flights if f.plan.method == "full"]
        own = ", ".join(f"{1000 * e:.1f}" for e in errors)
        lines += [f"## Preset `{name}`", "", *found.lines, ""]
        lines += [
            f"Hover error in its own model, by seed: {own} mm.",
            f"Policies admitted per adapted flight: {np.mean(swaps):.1f}.",
            "",
        ]
        if interrupted:
            break
    compiling = f"Compiling {watch.compile_s:.0f} s, all else {watch.total_s - watch.compile_s:.0f} s."
    lines += [compiling + (" Interrupted: incomplete." if interrupted else ""), ""]
    if pictured:
        lines += [f"![{preset[0]}, large disturbance, seed {seeds[0]}]({pictured[0].name})", ""]
    (folder / "hover.md").write_text("\n".join(lines))
    write_results(folder, name=table, seeds=seeds, watch=watch, rows=rows, interrupted=interrupted)
    console.print(f"[bold]{folder / 'hover.md'}[/]", soft_wrap=True)
    return 130 if interrupted else 0
