"""Table I of the paper: hover."""

from collections.abc import Sequence

from ...config.scenario import Scenario
from ..reporter import Reporter
from ..run import Run
from .document import Document
from .study import PaperRows, level_section, table_presets, train_all

PAPER: PaperRows = (  # Table I [m]
    ("base", ("0.128 ± 0.004", "0.328 ± 0.001", "1.228 ± 0.073")),
    ("adapted", ("0.015 ± 0.001", "0.008 ± 0.002", "0.105 ± 0.007")),
)


def hover(
    run: Run,
    reporter: Reporter,
    *,
    presets: Sequence[str] = ("hover/fast", "hover/released", "hover/paper"),
    seeds: Sequence[int] = (0, 1, 2),
    plant: str = "bem",
    sensors: str = "ideal",
    seconds: float = 30.0,
    starts: int = 8,
    methods: Sequence[str] = ("base", "base-i", "base-do", "full", "lora"),
) -> None:
    """Make ``hover.md``: three disturbances, for each preset, over several training seeds."""
    loaded = table_presets(presets, "hover", seeds=seeds, starts=starts, seconds=seconds)
    scenario = Scenario(plant=plant, sensors=sensors)
    intro = (
        f"Made by `retrim reproduce hover`. Steady-state error [m], the mean over the last 2 s of {seconds:g} s:\n"
        f"mean ± standard deviation over {len(seeds)} training seeds x {starts} starts. Plant `{plant}`, sensors\n"
        f"`{sensors}`, small quadrotor. Learning is charged to flight time by the preset's fixed latencies. The\n"
        "paper's rows are from its own plant."
    )
    document = Document(run, "hover", "Hover (Table I of the paper)", intro, seeds, reporter)
    for preset in loaded:
        study = train_all(preset, seeds, run, reporter)
        stem = f"hover_{preset.name.rpartition('/')[2]}"
        made = level_section(
            study,
            f"Preset {preset.name}",
            scenario,
            run,
            reporter,
            methods=methods,
            starts=starts,
            seconds=seconds,
            paper=PAPER,
            stem=stem,
        )
        if made is not None:
            document.add(*made)
        if run.interrupted:
            break
    document.write()
