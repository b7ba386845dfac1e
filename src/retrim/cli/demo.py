"""``retrim demo``: the whole loop in two minutes."""

import sys
import webbrowser
from pathlib import Path
from typing import Literal

from .. import presets
from ..checkpoint import save_policy
from ..testbed import ABOUT, PlantName
from .fly import setting_for, write_events
from .hover_table import fly_table, hover_table
from .pictures import picture
from .session import Stopwatch, console, run_folder, write_results
from .training import nominal_error, train

WHY = {
    "fast": "trains in seconds, and its model has a command delay, as plants have (others: --preset paper, released)",
    "released": "the delay, observation and training size of the authors' code",
    "paper": "as printed: no delay in the model, no past commands in the observation",
}


def demo(
    preset: Literal["fast", "released", "paper"] = "fast",
    plant: PlantName = "simple",
    seconds: float = 30.0,
    starts: int = 8,
    seed: int = 0,
    out: Path | None = None,
) -> int:
    """Pretrain a hover policy, push it with disturbances that it never saw, and re-train it while it flies.

    Args:
        preset: fast trains in seconds and has the plant's delay in its model; paper and released take about a minute.
        plant: simple: rotors with linear drag, the quickest; bem: blade-element rotors; the others are extras.
        seconds: Length of a flight.
        starts: Flights per disturbance and method, each from another start.
        seed: Seed of everything.
        out: Folder for the policy, results.json and the pictures; a new one under runs/ by default.
    """
    watch = Stopwatch()
    if seconds < 3.0 or starts < 1:
        raise presets.PresetError(f"--seconds {seconds:g} --starts {starts}: at least 3 s and 1 start are needed")
    folder = run_folder(out, "demo")
    settings = presets.load(preset)
    console.print(f"preset [bold]{preset}[/]: {WHY[preset]}")
    setting = setting_for(settings, plant)
    console.print(f"{setting.flown} quadrotor on plant [bold]{plant}[/]: {ABOUT[plant]}")
    policy, losses, interrupted = train(settings, seed)
    if losses:
        save_policy(folder / "policy.safetensors", policy, settings)
    if interrupted:
        console.print(f"interrupted while pretraining, after {len(losses)} epochs; what there is lies in {folder}")
        return 130
    console.print(f"hover error in its own model: {1000 * nominal_error(settings, policy):.1f} mm")
    flights, interrupted = fly_table(settings, policy, setting, seconds=seconds, starts=starts, seed=seed)
    table = hover_table(flights, settings, setting)
    write_results(
        folder,
        seeds=[seed],
        watch=watch,
        rows=table.rows,
        interrupted=interrupted,
        preset=presets.values(settings),
        losses=losses,
    )
    write_events(flights, folder)
    console.print(table.shown)
    console.print(f"compiling {watch.compile_s:.0f} s, all else {watch.total_s - watch.compile_s:.0f} s")
    flown = dict.fromkeys(f.plan.disturbance for f in flights)
    pictures = [path for name in flown for path in picture(flights, settings, name, setting, folder)]
    for path in pictures:
        if path.suffix == ".png":
            console.print(f"[bold]{path}[/]", soft_wrap=True)
    best = folder / "hover_large.png"
    if best in pictures and sys.stdout.isatty():
        webbrowser.open(best.resolve().as_uri())
    return 130 if interrupted else 0
