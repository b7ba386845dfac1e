"""Makes Table III of the paper: hover from keypoints."""

from collections.abc import Sequence

from retrim.config.presets import Preset
from retrim.config.scenario import Scenario
from retrim.control.baselines import BASELINES
from retrim.errors import ConfigError
from retrim.evaluation.study import table_presets
from retrim.runkit.document import Document
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run

from ..datt.training import RIVALS
from .levels import METHODS, Levels, PaperRows, fly_levels

PAPER: PaperRows = {  # Table III [m]
    "base": ("0.133 ± 0.009", "0.404 ± 0.039", "1.383 ± 0.176"),
    "full": ("0.082 ± 0.009", "0.099 ± 0.021", "0.207 ± 0.041"),
    "lora": ("0.084 ± 0.014", "0.111 ± 0.024", "0.205 ± 0.048"),
}
TITLES = {
    "vision/retrim": "Our preset: only points in the image, 1 px of noise, 5 % missed; effective gravity",
    "vision/ideal": "The paper's loop, a small budget: all points are observed",
    "vision/occluded": "The paper's loop, a small budget: only points in the image, 1 px of noise, 5 % of them missed",
    "vision/paper": "The paper's formulation: its reward and sizes, raw pixels, all points are observed",
}
INTRO = """\
Made by `retrim reproduce vision`. Steady-state error [m], the mean over the last 2 s: mean ± standard deviation
over flights. Small quadrotor; seven points on the ground, five frames, three past commands, no state. The
residual is learned from the state, as in the paper. Learning is charged to flight time by the preset's fixed
latencies. Controllers without a policy use the estimate of the pose filter, which receives the points that the policy
observes; INDI also has an inertial unit, which the policy does not have. In brackets the paper's figures,
which are from its own plant."""


def vision(
    run: Run,
    reporter: Reporter,
    *,
    presets: tuple[str, ...] = tuple(TITLES),
    methods: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0,),
    seconds: float = 30.0,
    starts: int = 8,
    plant: str = "bem",
) -> None:
    """Table III: hover from seven points on the ground under three disturbances.

    Args:
        run: Folder for vision.md, vision.json and the pictures.
        reporter: Receives progress and the sections.
        presets: Presets to train and fly; vision/paper trains for several minutes.
        methods: Methods to fly; by default all that the preset supports. Baselines use the estimate of a pose filter,
            and base-do uses the frame of effective gravity.
        seeds: Training seeds.
        seconds: Length of a flight [s].
        starts: Flights per disturbance, method and seed.
        plant: Plant for the flights.
    """
    bases = table_presets(presets, "vision", seeds=seeds, starts=starts, seconds=seconds)
    if rival_methods := [method for method in methods if method in RIVALS]:
        raise ConfigError(f"--methods {rival_methods[0]}: it is trained by a measured state; this table has none")
    document = Document(run, "vision", "Hover from keypoints (Table III of the paper)", INTRO, seeds, reporter)
    sections = [_section(preset, Scenario(plant=plant), methods) for preset in bases]
    fly_levels(document, sections, starts=starts, seconds=seconds)


def _section(preset: Preset, scenario: Scenario, methods: Sequence[str]) -> Levels:
    stem = f"vision_{preset.name.rpartition('/')[2]}"
    drawn_methods = ("base", "indi", "full")
    own_methods = methods or _flyable(preset)
    return Levels(
        TITLES.get(preset.name, preset.name), preset, scenario, stem, own_methods, PAPER, drawn_methods=drawn_methods
    )


def _flyable(preset: Preset) -> list[str]:
    """Return the other tables' methods that work with keypoints or with a filter's pose estimate."""
    cannot = {"base-i"}
    if preset.adapt.frame != "gravity":
        cannot.add("base-do")
    if preset.vision is None or not preset.vision.occlusion:
        cannot.update(BASELINES)
    return [method for method in METHODS if method not in cannot]
