"""``retrim reproduce tracking``: circle, figure-8 and star (Table II of the paper)."""

from pathlib import Path

from ... import presets
from ...testbed import PlantName
from ..session import run_folder
from .task_table import Block, table, with_reference

PAPER = {  # Table II [m]
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
ABOUT = (
    "# Tracking (Table II of the paper)",
    "",
    "Made by `retrim reproduce tracking`. Mean distance from where the reference is at the time [m], over the last",
    "10 s; mean ± standard deviation over starts. Cross-track: distance from the nearest point of the lap. Small",
    "quadrotor. Preset `track`: one policy, trained on all three references, sees them ahead. `track-paper`: it has",
    "o = [p, R, v] and the paper's reward, a policy for each reference. The paper's rows are from its own plant; its",
    "circle and ours take 3 s.",
)


def tracking(
    plant: PlantName = "bem",
    preset: tuple[str, ...] = ("track", "track-paper"),
    seconds: float = 60.0,
    starts: int = 8,
    seed: int = 0,
    out: Path | None = None,
) -> int:
    """Table II: circle, figure-8 and star under three disturbances, and a figure-8 that training never saw.

    Args:
        plant: Where the policies fly.
        preset: Presets to train and fly.
        seconds: Length of a flight.
        starts: Flights per disturbance and method.
        seed: Seed of training, starts and learners.
        out: Folder for tracking.md, tracking.json and pictures; a new one under runs/ by default.
    """
    blocks = list[Block]()
    for name in preset:
        settings = presets.load(name)
        for reference, paper in PAPER.items():
            if settings.observation == "preview":
                blocks.append(Block(f"{reference}, seeing it ahead", settings, reference, paper=paper))
            else:
                own = with_reference(name, reference)
                blocks.append(Block(f"{reference}, without seeing it", own, reference, paper=paper))
        if settings.observation == "preview":
            other = with_reference(name, "circle+star")
            blocks.append(Block("figure8, never seen in training", other, "figure8", ("base", "full")))
    folder = run_folder(out, "reproduce")
    return table("tracking", ABOUT, blocks, plant=plant, seconds=seconds, starts=starts, seed=seed, folder=folder)
