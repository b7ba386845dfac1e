"""``retrim reproduce hover``: Table I of the paper."""

from pathlib import Path
from typing import Any, Literal

from ... import presets
from ...presets import Preset
from ...testbed import PlantName, Setting
from ..flights import Flight
from ..fly import setting_for
from ..hover_table import fly_table, hover_table
from ..pictures import picture
from ..session import Stopwatch, commit, console, machine, run_folder, write_results
from ..training import nominal_error, train


def hover(
    preset: tuple[Literal["fast", "released", "paper"], ...] = ("fast", "released", "paper"),
    seeds: tuple[int, ...] = (0, 1, 2),
    seconds: float = 30.0,
    starts: int = 8,
    plant: PlantName = "bem",
    out: Path | None = None,
) -> int:
    """Table I: hover under three disturbances, for each preset, over several training seeds.

    Args:
        preset: Presets to train and fly.
        seeds: Training seeds; each also seeds the starts and the learners of its flights.
        seconds: Length of a flight.
        starts: Flights per disturbance, method and seed.
        plant: Where the policies fly.
        out: Folder for hover.md, hover.json and a picture; a new one under runs/ by default.
    """
    watch = Stopwatch()
    folder = run_folder(out, "reproduce")
    sections, rows, interrupted = list[str](), list[dict[str, Any]](), False
    for name in preset:
        settings = presets.load(name)
        setting = setting_for(settings, plant)
        flights, errors, interrupted = _flown(settings, setting, seeds, seconds, starts)
        if flights:
            found = hover_table(flights, settings, setting)
            console.print(found.shown)
            rows += [{**row, "preset": name} for row in found.rows]
            sections += _section(name, found.lines, flights, errors)
        pictured = [f for f in flights if f.plan.disturbance == "large"][: 2 * starts]  # those of the first seed
        if name == preset[0] and pictured:
            path, _ = picture(pictured, settings, "large", setting, folder)
            sections += [f"![{name}, large disturbance, seed {seeds[0]}]({path.name})", ""]
        # after each preset, so that an interruption loses nothing
        text = [*_head(plant, seeds, seconds, starts), *sections, *_foot(watch, interrupted)]
        (folder / "hover.md").write_text("\n".join(text))
        write_results(folder, name="hover", seeds=seeds, watch=watch, rows=rows, interrupted=interrupted)
        if interrupted:
            break
    console.print(f"[bold]{folder / 'hover.md'}[/]", soft_wrap=True)
    return 130 if interrupted else 0


def _flown(
    settings: Preset, setting: Setting, seeds: tuple[int, ...], seconds: float, starts: int
) -> tuple[list[Flight], list[float], bool]:
    """All flights of one preset, the policies' errors in their own model, and whether Ctrl-C cut them short."""
    flights, errors, interrupted = list[Flight](), list[float](), False
    try:
        for seed in seeds:
            console.print(f"[bold]{settings.name}[/], seed {seed}")
            policy, _, interrupted = train(settings, seed)
            if interrupted:
                break
            errors.append(nominal_error(settings, policy))
            flown, interrupted = fly_table(settings, policy, setting, seconds=seconds, starts=starts, seed=seed)
            flights += flown
            if interrupted:
                break
    except KeyboardInterrupt:
        interrupted = True
    return flights, errors, interrupted


def _head(plant: str, seeds: tuple[int, ...], seconds: float, starts: int) -> list[str]:
    many = f"{len(seeds)} training seeds ({', '.join(map(str, seeds))}) x {starts} starts"
    return [
        "# Hover (Table I of the paper, base policy and full adaptation)",
        "",
        f"Made by `retrim reproduce hover`. Steady-state error [m], over the last 2 s of {seconds:g} s: mean ±",
        f"standard deviation over {many}. Plant `{plant}`, small quadrotor. Learning",
        "is charged to flight time, by the preset's fixed figures. The paper's rows are from its own plant.",
        "",
        f"Commit {commit()}; {machine()}.",
        "",
    ]


def _section(name: str, lines: list[str], flights: list[Flight], errors: list[float]) -> list[str]:
    own = ", ".join(f"{1000 * error:.1f}" for error in errors)
    events = [e.kind for f in flights for e in f.events]
    return [
        f"## Preset `{name}`",
        "",
        *lines,
        "",
        f"Hover error in its own model, by seed: {own} mm. The gate admitted {events.count('policy')} policies,",
        f"and refused {events.count('rejected')}.",
        f"Crashed: {sum(f.log.crashed for f in flights)} of {len(flights)} flights.",
        "",
    ]


def _foot(watch: Stopwatch, interrupted: bool) -> list[str]:
    times = f"Compiling {watch.compile_s:.0f} s, all else {watch.total_s - watch.compile_s:.0f} s."
    return [times + (" Interrupted: incomplete." if interrupted else ""), ""]
