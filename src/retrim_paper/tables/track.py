"""Makes Table II of the paper: the circle, figure-8 and star."""

from collections.abc import Sequence

from retrim.config.loading import changed
from retrim.config.presets import Preset
from retrim.config.scenario import Scenario
from retrim.evaluation.study import table_presets
from retrim.runkit.document import Document
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run

from ..datt.training import DATT_STEPS
from .levels import METHODS, Levels, PaperRows, fly_levels, of_policies

PAPER: dict[str, PaperRows] = {  # Table II [m]
    "circle": {
        "base": ("0.365 ± 0.124", "0.571 ± 0.091", "1.479 ± 0.213"),
        "l1-mpc": ("0.113 ± 0.027", "0.096 ± 0.063", "0.410 ± 0.155"),
        "datt": ("0.058 ± 0.016", "0.040 ± 0.024", "crash"),
        "full": ("0.167 ± 0.048", "0.135 ± 0.101", "0.349 ± 0.175"),
        "lora": ("0.129 ± 0.051", "0.159 ± 0.043", "0.326 ± 0.061"),
    },
    "figure8": {
        "base": ("0.313 ± 0.087", "0.492 ± 0.155", "1.363 ± 0.382"),
        "l1-mpc": ("0.109 ± 0.063", "0.121 ± 0.025", "0.281 ± 0.097"),
        "datt": ("0.078 ± 0.037", "0.082 ± 0.046", "crash"),
        "full": ("0.068 ± 0.040", "0.045 ± 0.030", "0.137 ± 0.098"),
        "lora": ("0.069 ± 0.047", "0.059 ± 0.043", "0.110 ± 0.037"),
    },
    "star": {
        "base": ("0.453 ± 0.190", "0.467 ± 0.236", "0.844 ± 0.389"),
        "l1-mpc": ("0.295 ± 0.086", "0.218 ± 0.111", "0.417 ± 0.086"),
        "datt": ("0.087 ± 0.059", "0.102 ± 0.093", "crash"),
        "full": ("0.126 ± 0.094", "0.133 ± 0.075", "0.211 ± 0.116"),
        "lora": ("0.129 ± 0.069", "0.130 ± 0.099", "0.231 ± 0.076"),
    },
}
INTRO = """\
Made by `retrim reproduce track`. Mean distance from the present point of the reference [m], over the last 10
s: mean ± standard deviation over flights. In step: after the best constant shift in time. Cross-track:
distance from the nearest point of the lap. Small quadrotor. Presets `track/retrim` and `track/preview`: one
policy, trained on all three references, observes them ahead; `track/retrim` flies and adapts in the frame of
effective gravity. `track/paper`: the paper's reward, network and loop with o = [p, R, v, p - p_ref, v - v_ref], one
policy per reference; `retrim reproduce phase` compares readings of the observation.
Learning is charged to flight time by the preset's fixed latencies. In brackets the paper's figures, which are
from its own plant; its circle and ours take 3 s."""


def track(
    run: Run,
    reporter: Reporter,
    *,
    presets: tuple[str, ...] = ("track/retrim", "track/paper"),
    methods: tuple[str, ...] = METHODS,
    datt_steps: int = DATT_STEPS,
    seeds: tuple[int, ...] = (0, 1, 2),
    seconds: float = 60.0,
    starts: int = 8,
    plant: str = "bem",
) -> None:
    """Table II: the circle, figure-8 and star under three disturbances, and a figure-8 that was not trained on.

    Args:
        run: Folder for track.md, track.json and the pictures.
        reporter: Receives progress and the sections.
        presets: Presets to train and fly.
        methods: Methods for the policies, and baselines without a policy; baselines fly only with the first preset.
        datt_steps: Number of training steps for DATT, if it is among the methods.
        seeds: Training seeds.
        seconds: Length of a flight [s].
        starts: Flights per disturbance, method and seed.
        plant: Plant for the flights.
    """
    bases = table_presets(presets, "track", seeds=seeds, starts=starts, seconds=seconds)
    sections = [
        section
        for preset in bases
        for section in _sections(preset, plant, methods if preset is bases[0] else of_policies(methods))
    ]
    document = Document(run, "track", "Tracking (Table II of the paper)", INTRO, seeds, reporter)
    fly_levels(document, sections, starts=starts, seconds=seconds, datt_steps=datt_steps)


def _sections(preset: Preset, plant: str, methods: Sequence[str]) -> list[Levels]:
    """Return a section per reference; policies with preview are trained on all of them, others on one each."""

    def section(
        title: str, preset: Preset, reference: str, paper: PaperRows, methods: Sequence[str] = methods
    ) -> Levels:
        training_name = preset.track.reference.replace("+", "-") if preset.track else ""
        stem = "_".join(["track", preset.name.rpartition("/")[2], reference, training_name])
        return Levels(title, preset, Scenario(plant=plant, reference=reference), stem, methods, paper)

    if preset.track is not None and preset.track.looks_ahead:
        unseen = changed(preset, track={"reference": "circle+star"})
        return [
            *(section(f"{name}, seen ahead", preset, name, paper) for name, paper in PAPER.items()),
            section("figure8, never seen in training", unseen, "figure8", {}, of_policies(methods)),
        ]
    return [
        section(f"{name}, {preset.name}", changed(preset, track={"reference": name}), name, paper)
        for name, paper in PAPER.items()
    ]
