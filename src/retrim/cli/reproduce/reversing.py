"""``retrim reproduce reversing``: hover under a push that turns around every 15 s (the paper's Sec. IV-B.3)."""

from pathlib import Path

import numpy as np

from ... import presets
from ...presets import Adapt
from ...testbed import PlantName
from ..flights import Campaign, Flight, Method, Plan
from ..fly import setting_for
from ..pictures import picture
from ..scores import rows
from ..session import Stopwatch, commit, console, machine, run_folder, write_results
from ..training import nominal_error, train

PERIOD = 15.0  # [s]
METHODS: dict[Method, str] = {"base": "base policy", "full": "**adapted**"}
ABOUT = (
    "# Hover under a push that reverses (Sec. IV-B.3 of the paper)",
    "",
    "Made by `retrim reproduce reversing`. ±0.5 m/s² on each axis, reversed every 15 s. Mean error [m] over a second:",
    "that before the reversal, that before the next update ends, and that before each later one or the next reversal;",
    "mean ± standard deviation over starts. An update starts every 5 s and flies a second later; the first that ends",
    "after a reversal was still learnt from the flight before it.",
)


def reversing(
    preset: str = "fast",
    plant: PlantName = "bem",
    seconds: float = 60.0,
    starts: int = 8,
    seed: int = 0,
    out: Path | None = None,
) -> int:
    """Hover under a push that reverses every 15 s: the error before and after each update, and the picture.

    Args:
        preset: A preset for hover, to train with.
        plant: Where the policy flies.
        seconds: Length of a flight.
        starts: Flights per method.
        seed: Seed of training, starts and learners.
        out: Folder for reversing.md, reversing.json and the picture; a new one under runs/ by default.
    """
    watch, settings = Stopwatch(), presets.load(preset)
    if settings.task != "hover" or seconds < 2 * PERIOD or starts < 1:
        raise presets.PresetError(
            f"{preset}, {seconds:g} s, {starts} starts: needs a preset for hover, {2 * PERIOD:g} s and 1 start"
        )
    folder, setting = run_folder(out, "reproduce"), setting_for(settings, plant)
    policy, _, interrupted = train(settings, seed)
    if interrupted:
        console.print("interrupted while pretraining; nothing was saved")
        return 130
    campaign = Campaign(settings, policy, setting=setting, seconds=seconds, starts=starts, seed=seed)
    campaign.warm_up(["reversing"])
    flights, interrupted = campaign.fly([Plan("reversing", m, i) for m in METHODS for i in range(starts)])
    if not flights:
        console.print("interrupted before the first flight was over; nothing was saved")
        return 130
    moments = _moments(settings.adapt, seconds)
    errors = {m: [_errors(f, moments) for f in flights if f.plan.method == m and not f.log.crashed] for m in METHODS}
    table = _lines(errors, moments)
    found = rows(flights, task=settings.task, setting=setting)
    crashed = sum(row["crashes"] for row in found)
    console.print("\n".join(table), markup=False, soft_wrap=True)
    path, _ = picture(flights, settings, "reversing", setting, folder)
    own = 1000 * nominal_error(settings, policy)
    foot = f"Compiling {watch.compile_s:.0f} s, all else {watch.total_s - watch.compile_s:.0f} s."
    text = [*ABOUT, "", f"Preset `{preset}`, {own:.1f} mm in its own model. Commit {commit()};",
            f"{machine()}. Plant `{plant}`, seed {seed}, {starts} starts,",
            f"{seconds:g} s each; {crashed} of {len(flights)} flights crashed.",
            "Learning is charged to flight time, by the preset's fixed figures.", "",
            *table, "", f"![errors over time]({path.name})", "",
            foot + (" Interrupted: incomplete." if interrupted else ""), ""]  # fmt: skip
    (folder / "reversing.md").write_text("\n".join(text))
    read = {method: np.array(errors[method]).tolist() for method in METHODS}
    write_results(folder, name="reversing", seeds=[seed], watch=watch, rows=found, interrupted=interrupted,
                  moments_s=moments.tolist(), errors_m=read)  # fmt: skip
    console.print(f"[bold]{folder / 'reversing.md'}[/]", soft_wrap=True)
    return 130 if interrupted else 0


def _moments(adapt: Adapt, seconds: float) -> np.ndarray:
    """When the errors are read [s]: for each reversal, at it, and at the end of what each update leads to."""
    turns = np.arange(PERIOD, seconds - PERIOD / 2, PERIOD)
    swaps = np.arange(adapt.improve_charge, PERIOD, adapt.improve_every)
    moments: np.ndarray = np.minimum(turns[:, None] + np.concatenate([[0.0], swaps, [PERIOD]])[None], seconds)
    return moments


def _errors(flight: Flight, moments: np.ndarray) -> np.ndarray:
    """Mean over the second before each moment [m]."""
    t = flight.log.t
    found = [flight.error[(t > end - 1.0) & (t <= end + 1e-6)].mean() for end in moments.flat]
    return np.array(found).reshape(moments.shape)


def _lines(errors: dict[Method, list[np.ndarray]], moments: np.ndarray) -> list[str]:
    updates = [f"after update {i}" for i in range(1, moments.shape[1] - 1)]
    heads = ["", "just before it", "before an update ends", *updates]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for i, reversal in enumerate(moments[:, 0]):
        for method, name in METHODS.items():
            table = [found[i] for found in errors[method]]
            columns = np.array(table).T  # empty where none was flown to its end
            cells = [f"{c.mean():.3f} ± {c.std(ddof=len(table) > 1):.3f}" for c in columns] or ["-"]
            lines.append("| " + " | ".join([f"reversed at {reversal:g} s, {name}", *cells]) + " |")
    return lines
