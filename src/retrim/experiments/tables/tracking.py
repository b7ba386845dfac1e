"""Table II of the paper: circle, figure-8 and star."""

from collections.abc import Sequence
from dataclasses import replace

from ...config.loading import changed
from ...config.presets import Preset
from ...config.scenario import Scenario
from ..reporter import Reporter
from ..run import Run
from .document import Document
from .study import PaperRows, Study, level_section, table_presets, train_all

PAPER: dict[str, PaperRows] = {  # Table II [m]
    "circle": (
        ("base", ("0.365 ± 0.124", "0.571 ± 0.091", "1.479 ± 0.213")),
        ("adapted", ("0.167 ± 0.048", "0.135 ± 0.101", "0.349 ± 0.175")),
        ("LoRA", ("0.129 ± 0.051", "0.159 ± 0.043", "0.326 ± 0.061")),
        ("best baseline", ("0.058 ± 0.016", "0.040 ± 0.024", "0.410 ± 0.155")),
    ),
    "figure8": (
        ("base", ("0.313 ± 0.087", "0.492 ± 0.155", "1.363 ± 0.382")),
        ("adapted", ("0.068 ± 0.040", "0.045 ± 0.030", "0.137 ± 0.098")),
        ("LoRA", ("0.069 ± 0.047", "0.059 ± 0.043", "0.110 ± 0.037")),
        ("best baseline", ("0.078 ± 0.037", "0.082 ± 0.046", "0.281 ± 0.097")),
    ),
    "star": (
        ("base", ("0.453 ± 0.190", "0.467 ± 0.236", "0.844 ± 0.389")),
        ("adapted", ("0.126 ± 0.094", "0.133 ± 0.075", "0.211 ± 0.116")),
        ("LoRA", ("0.129 ± 0.069", "0.130 ± 0.099", "0.231 ± 0.076")),
        ("best baseline", ("0.087 ± 0.059", "0.102 ± 0.093", "0.417 ± 0.086")),
    ),
}
INTRO = """\
Made by `retrim reproduce tracking`. Mean distance from where the reference is at the time [m], over the last 10
s: mean ± standard deviation over flights. Cross-track: distance from the nearest point of the lap. Small
quadrotor. Preset `track/preview`: one policy, trained on all three references, sees them ahead. `track/paper`:
the paper's observation o = [p, R, v] and reward, one policy per reference. Learning is charged to flight time
by the preset's fixed latencies. The paper's rows are from its own plant; its circle and ours take 3 s."""
ALL: tuple[str, ...] = ("base", "full", "lora")


def tracking(
    run: Run,
    reporter: Reporter,
    *,
    presets: Sequence[str] = ("track/preview", "track/paper"),
    seeds: Sequence[int] = (0,),
    plant: str = "bem",
    seconds: float = 60.0,
    starts: int = 8,
) -> None:
    """Make ``tracking.md``: three references under three disturbances, and a figure-8 that training never saw."""
    loaded = table_presets(presets, "track", seeds=seeds, starts=starts, seconds=seconds)
    sections = [section for preset in loaded for section in _sections(preset)]
    base = Scenario(plant=plant)
    document = Document(run, "tracking", "Tracking (Table II of the paper)", INTRO, seeds, reporter)
    studies = dict[str, Study]()
    for title, preset, reference, methods, paper in sections:
        trained_on = preset.track.reference if preset.track else ""
        key = f"{preset.name} {trained_on}"
        if key not in studies:
            studies[key] = train_all(preset, seeds, run, reporter)
        stem = "_".join(["tracking", preset.name.rpartition("/")[2], reference, trained_on.replace("+", "-")])
        made = level_section(
            studies[key], title, replace(base, reference=reference), run, reporter,
            methods=methods, starts=starts, seconds=seconds, paper=paper, stem=stem,
        )  # fmt: skip
        if made is not None:
            document.add(*made)
        if run.interrupted:
            break
    document.write()


def _sections(preset: Preset) -> list[tuple[str, Preset, str, tuple[str, ...], PaperRows]]:
    """Title, preset, reference, methods and the paper's rows of each section of a preset."""
    if preset.track is not None and preset.track.observation == "preview":
        unseen = changed(preset, track={"reference": "circle+star"})
        return [
            *((f"{name}, seen ahead", preset, name, ALL, paper) for name, paper in PAPER.items()),
            ("figure8, never seen in training", unseen, "figure8", ("base", "full"), ()),
        ]
    return [
        (f"{name}, not seen", changed(preset, track={"reference": name}), name, ALL, paper)
        for name, paper in PAPER.items()
    ]
