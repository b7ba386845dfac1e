"""The paper's own formulation of tracking, read in several ways: a policy that does not see its reference."""

from collections.abc import Mapping, Sequence
from typing import Any

from ...config.loading import changed
from ...config.scenario import Scenario
from ...errors import ConfigError
from ..reporter import Reporter
from ..run import Run
from .document import Document
from .levels import Levels, fly_levels
from .study import table_presets
from .track import PAPER

INTRO = """\
Made by `retrim reproduce phase`. In the paper's formulation a tracking policy sees position, attitude and velocity, and
its reference in the reward alone: the closed loop is a clock of its own, whose phase nothing that it sees can correct.
Error over the last 10 s [m]: mean ± standard deviation over flights, at the reference's own time; in step: but for the
best constant shift in time; cross-track: from the nearest point of the lap. In brackets the paper's figures, which are
from its own plant. One policy for each reference and reading. Readings:"""
NEAR: dict[str, Any] = {"start_spread": 0.1}
RELEASED: dict[str, Any] = {"delay_ticks": 2, "command_history": 3}
READINGS: dict[str, tuple[str, dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "printed": ("o = [p, R, v], no delay in the model, starts within 30 cm of the reference", {}, {}, {}),
    "released": (
        "as the authors' code: 40 ms of delay in the model, the last three commands observed, starts within 10 cm",
        RELEASED, NEAR, {},
    ),
    "flown": (
        "the same, and updates start where the vehicle has been, at the reference's time then",
        RELEASED, NEAR, {"task_starts": 0, "start_noise": 0.05},
    ),
}  # fmt: skip
"""What it is, and changes of the preset, of its table [track], and of its table [adapt]."""


def phase(
    run: Run,
    reporter: Reporter,
    *,
    readings: tuple[str, ...] = tuple(READINGS),
    references: tuple[str, ...] = ("figure8", "circle"),
    methods: tuple[str, ...] = ("base", "full"),
    seeds: tuple[int, ...] = (0,),
    seconds: float = 60.0,
    starts: int = 4,
    plant: str = "bem",
) -> None:
    """Tracking as the paper formulates it, where the policy does not see its reference, read in several ways.

    Args:
        run: Folder of phase.md, phase.json and the pictures.
        reporter: Receives progress and the sections.
        readings: printed, released, flown.
        references: circle, figure8, star.
        methods: How they fly.
        seeds: Training seeds.
        seconds: Length of a flight [s].
        starts: Flights per disturbance, method and seed.
        plant: Where they fly.
    """
    _check("reading", readings, READINGS)
    _check("reference", references, PAPER)
    (printed,) = table_presets(["track/paper"], "track", seeds=seeds, starts=starts, seconds=seconds)
    sections = []
    for reference in references:
        for reading in readings:
            _, more, track, adapt = READINGS[reading]
            own = changed(printed, **more, track={**track, "reference": reference}, adapt=adapt)
            scenario, stem = Scenario(plant=plant, reference=reference), f"phase_{reference}_{reading}"
            sections.append(Levels(f"{reference}, {reading}", own, scenario, stem, methods, PAPER[reference]))
    about = "\n".join(f"* {name}: {READINGS[name][0]}" for name in readings)
    document = Document(run, "phase", "Tracking without seeing the reference", f"{INTRO}\n\n{about}", seeds, reporter)
    fly_levels(document, sections, starts=starts, seconds=seconds)


def _check(what: str, names: Sequence[str], known: Mapping[str, Any]) -> None:
    for name in names:
        if name not in known:
            raise ConfigError(f"{what} {name!r}: there are {', '.join(known)}")
