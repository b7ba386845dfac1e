"""Table III of the paper: hover from keypoints."""

from collections.abc import Sequence

from ...config.scenario import Scenario
from ..reporter import Reporter
from ..run import Run
from .document import Document
from .study import PaperRows, level_section, table_presets, train_all

PAPER: PaperRows = (  # Table III [m]
    ("base", ("0.133 ± 0.009", "0.404 ± 0.039", "1.383 ± 0.176")),
    ("adapted", ("0.082 ± 0.009", "0.099 ± 0.021", "0.207 ± 0.041")),
    ("LoRA", ("0.084 ± 0.014", "0.111 ± 0.024", "0.205 ± 0.048")),
)
TITLES = {
    "vision/ideal": "Our preset: all points are observed",
    "vision/occluded": "Our preset: only points in the image, 1 px of noise, 5 % of them missed",
    "vision/paper": "The paper's formulation: its reward and sizes, raw pixels, all points are observed",
}
INTRO = """\
Made by `retrim reproduce vision`. Steady-state error [m], the mean over the last 2 s: mean ± standard deviation
over flights. Small quadrotor; seven points on the ground, five frames, three past commands, no state. The
residual is learnt from the state, as in the paper. Learning is charged to flight time by the preset's fixed
latencies. The paper's rows are from its own plant."""


def vision(
    run: Run,
    reporter: Reporter,
    *,
    presets: Sequence[str] = tuple(TITLES),
    seeds: Sequence[int] = (0,),
    plant: str = "bem",
    seconds: float = 30.0,
    starts: int = 8,
) -> None:
    """Make ``vision.md``: hover from seven points on the ground under three disturbances."""
    loaded = table_presets(presets, "vision", seeds=seeds, starts=starts, seconds=seconds)
    scenario = Scenario(plant=plant)
    document = Document(run, "vision", "Hover from keypoints (Table III of the paper)", INTRO, seeds, reporter)
    for preset in loaded:
        study = train_all(preset, seeds, run, reporter)
        # An update of the paper's size takes seconds; its preset adapts all weights only.
        methods: tuple[str, ...] = ("base", "full") if preset.name == "vision/paper" else ("base", "full", "lora")
        stem = f"vision_{preset.name.rpartition('/')[2]}"
        made = level_section(
            study, TITLES.get(preset.name, preset.name), scenario, run, reporter,
            methods=methods, starts=starts, seconds=seconds, paper=PAPER, stem=stem,
        )  # fmt: skip
        if made is not None:
            document.add(*made)
        if run.interrupted:
            break
    document.write()
