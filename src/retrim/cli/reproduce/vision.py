"""``retrim reproduce vision``: hover from what a camera shows (Table III of the paper)."""

from pathlib import Path

from ... import presets
from ...testbed import PlantName
from ..flights import Method
from ..session import run_folder
from .task_table import Block, table

PAPER = (  # Table III [m]
    ("base", ("0.133 ± 0.009", "0.404 ± 0.039", "1.383 ± 0.176")),
    ("adapted", ("0.082 ± 0.009", "0.099 ± 0.021", "0.207 ± 0.041")),
    ("LoRA", ("0.084 ± 0.014", "0.111 ± 0.024", "0.205 ± 0.048")),
)
TITLES = {
    "vision": "all points fed, as in the paper",
    "vision-honest": "only what the camera sees, 1 px of noise, 5 % of the points missed",
    "vision-paper": "all points fed, the paper's sizes, raw pixels",
}
ABOUT = (
    "# Hover from what a camera shows (Table III of the paper)",
    "",
    "Made by `retrim reproduce vision`. Steady-state error [m], over the last 2 s; mean ± standard deviation over",
    "starts. Small quadrotor; seven points on the ground, five frames, three past commands, no state. The residual is",
    "learnt from the state, as in the paper. The paper's rows are from its own plant.",
)


def vision(
    plant: PlantName = "bem",
    preset: tuple[str, ...] = tuple(TITLES),
    seconds: float = 30.0,
    starts: int = 8,
    seed: int = 0,
    out: Path | None = None,
) -> int:
    """Table III: hover from seven points on the ground under three disturbances.

    Args:
        plant: Where the policies fly.
        preset: Presets to train and fly; vision-paper trains for several minutes.
        seconds: Length of a flight.
        starts: Flights per disturbance and method.
        seed: Seed of training, starts and learners.
        out: Folder for vision.md, vision.json and pictures; a new one under runs/ by default.
    """
    blocks = [_block(name) for name in preset]
    folder = run_folder(out, "reproduce")
    return table("vision", ABOUT, blocks, plant=plant, seconds=seconds, starts=starts, seed=seed, folder=folder)


def _block(name: str) -> Block:
    """An update of the paper's size takes seconds; its preset adapts all weights only."""
    methods: tuple[Method, ...] = ("base", "full") if name == "vision-paper" else ("base", "full", "lora")
    return Block(TITLES.get(name, name), presets.load(name), methods=methods, paper=PAPER)
