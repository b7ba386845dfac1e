"""The ten cells of the benchmark, their published errors, and the preset that flies them.

One policy flies all cells. No setting depends on the cell.
"""

from dataclasses import replace
from typing import NamedTuple

from retrim.config.loading import changed, load
from retrim.config.presets import Preset

from .plant import vehicle_file
from .references import NAMES, SPEEDS

SECONDS = 20.0  # [s], length of a flight; the second half counts


class Published(NamedTuple):
    """Mean errors in one cell [mm] (arXiv 2203.07747, Table III)."""

    learned: int
    """Their best network, trained on 20,000 points of earlier flights."""
    perfect: int
    """Model-predictive control with the true model."""

    def text(self) -> str:
        """Return the errors in words."""
        return f"{self.learned} mm learned, {self.perfect} mm perfect model (arXiv 2203.07747)"


_LEARNED = (10, 14, 17, 22, 23, 11, 17, 27, 27, 46)
_PERFECT = (1, 0, 1, 1, 2, 0, 1, 3, 11, 28)
PUBLISHED_ERRORS = {
    name: Published(*pair) for name, pair in zip(NAMES, zip(_LEARNED, _PERFECT, strict=True), strict=True)
}
"""Published errors by the name of the reference."""


def title_of(name: str) -> str:
    """Return the title of a cell, such as ``circle, 4.5 m/s``, from the name of its reference."""
    shape, _, speed = name.partition("-5m-")
    assert float(speed) in SPEEDS
    return f"{shape}, {speed} m/s"


def benchmark_preset() -> Preset:
    """Return the preset of the benchmark: one policy for all trajectories, which observes the thrust ahead.

    Short training with a high cost of command changes keeps the feedback soft enough for the torque of the rotors,
    which the nominal model does not limit.
    """
    base = load("track/paced")
    preset = changed(
        base,
        vehicle=vehicle_file(),
        reward="exact",
        jump_cost=0.1,
        track={"reference": "+".join(NAMES), "observation": "thrust", "gravity_copies": 0},
    )
    pretrain = replace(
        base.pretrain, num_updates=300, num_envs=48, learning_rate=1e-3, hidden_sizes=(64, 64), network="thrust"
    )
    return replace(preset, pretrain=pretrain, adapt=replace(base.adapt, residual="regression"))
