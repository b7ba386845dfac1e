"""Makes Table I of the paper: hover."""

from retrim.config.scenario import Scenario
from retrim.evaluation.study import table_presets
from retrim.runkit.document import Document
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run

from ..datt.training import DATT_STEPS
from .levels import METHODS, Levels, PaperRows, fly_levels, of_policies

PAPER: PaperRows = {  # Table I [m]
    "base": ("0.128 ± 0.004", "0.328 ± 0.001", "1.228 ± 0.073"),
    "l1-mpc": ("0.091 ± 0.052", "0.134 ± 0.073", "0.552 ± 0.130"),
    "datt": ("0.013 ± 0.004", "0.009 ± 0.005", "0.231 ± 0.004"),
    "full": ("0.015 ± 0.001", "0.008 ± 0.002", "0.105 ± 0.007"),
    "lora": ("0.023 ± 0.002", "0.015 ± 0.004", "0.125 ± 0.002"),
}


def hover(
    run: Run,
    reporter: Reporter,
    *,
    presets: tuple[str, ...] = ("hover/retrim", "hover/fast", "hover/released", "hover/paper"),
    seeds: tuple[int, ...] = (0, 1, 2),
    seconds: float = 30.0,
    starts: int = 8,
    plant: str = "bem",
    sensors: str = "ideal",
    methods: tuple[str, ...] = METHODS,
    datt_steps: int = DATT_STEPS,
) -> None:
    """Table I: hover under three disturbances, for each preset, over several training seeds.

    Args:
        run: Folder for hover.md, hover.json and the pictures.
        reporter: Receives progress and the sections.
        presets: Presets to train and fly.
        seeds: Training seeds; each also seeds the starts and learners of its flights.
        seconds: Length of a flight [s].
        starts: Flights per disturbance, method and seed.
        plant: Plant for the flights.
        sensors: Sensors that measure the state for the policies.
        methods: Methods for the policies, and baselines without a policy; baselines fly only with the first preset.
        datt_steps: Number of training steps for DATT, if it is among the methods.
    """
    bases = table_presets(presets, "hover", seeds=seeds, starts=starts, seconds=seconds)
    scenario = Scenario(plant=plant, sensors=sensors)
    intro = (
        f"Made by `retrim reproduce hover`. Steady-state error [m], the mean over the last 2 s of {seconds:g} s:\n"
        f"mean ± standard deviation over {len(seeds)} training seeds x {starts} starts. Plant `{plant}`, sensors\n"
        f"`{sensors}`, small quadrotor. Learning is charged to flight time by the preset's fixed latencies. In\n"
        "brackets the paper's figures, which are from its own plant."
    )
    document = Document(run, "hover", "Hover (Table I of the paper)", intro, seeds, reporter)
    sections = [
        Levels(
            f"Preset {preset.name}",
            preset,
            scenario,
            f"hover_{preset.name.rpartition('/')[2]}",
            methods if preset is bases[0] else of_policies(methods),
            PAPER,
        )
        for preset in bases
    ]
    fly_levels(document, sections, starts=starts, seconds=seconds, datt_steps=datt_steps)
