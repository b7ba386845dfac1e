"""Defines the components of an ablation; each is one difference between our presets and those of the paper."""

from dataclasses import dataclass, field
from typing import Any

LONG_UPDATES = {"num_updates": 30, "update_every": 5.0, "learning_rate": 1e-3, "update_latency": 1.0}
SHORT_UPDATES = {"num_updates": 5, "update_every": 0.5, "learning_rate": 1e-4, "update_latency": 0.1}
ENSEMBLE = {"residual": "ensemble", "fit_every": 3.0, "fit_steps": 100, "fit_latency": 0.2}
REGRESSION = {"residual": "regression", "fit_every": 0.2, "fit_latency": 0.02}
NO_UPDATES = {"update_every": 3600.0}


@dataclass(frozen=True)
class Lever:
    """One change to a preset or to the flight method."""

    label: str
    changes: dict[str, Any] = field(default_factory=dict)
    """Changed preset keys, in the format of :func:`retrim.changed`."""
    method: str = "full"


CONTROL = (
    Lever("base policy", method="base"),
    Lever("base policy + integral action", method="base-i"),
)
"""Control methods without learning."""

LAYERS_OFF = (
    Lever("**all levers**"),
    Lever("disturbance observer alone", method="base-do"),
    Lever("observer and regression, no bursts", {"adapt": NO_UPDATES}),
    Lever("bursts alone: no frame, no trim", {"adapt": {"frame": "world", "trim": "free"}}),
    Lever("ensemble instead of regression", {"adapt": ENSEMBLE}),
    Lever("long updates instead of bursts", {"adapt": LONG_UPDATES}),
    Lever("all starts from the task", {"adapt": {"task_starts": None}}),
    Lever("a new Adam for each burst", {"adapt": {"optimiser": "fresh"}}),
)
"""Ablations that are the same for every task."""

OFF: dict[str, tuple[Lever, ...]] = {
    "hover": (
        *LAYERS_OFF,
        Lever("no trim", {"adapt": {"trim": "free"}}),
        Lever("the paper's reward", {"reward": "paper"}),
        Lever("no cost of jumps", {"jump_cost": 0.0}),
        Lever("no past commands", {"command_history": 0}),
        Lever("no delay in the model", {"delay_ticks": 0}),
    ),
    "track": (
        *LAYERS_OFF,
        Lever("no ensemble on what the regression leaves", {"adapt": {"residual": "regression"}}),
        Lever("references as they are only", {"track": {"gravity_copies": 0}}),
        Lever("no acceleration and jerk seen", {"track": {"observation": "preview"}}),
        Lever("no tip in the reward", {"reward": "l2"}),
        Lever("no cost of jumps", {"jump_cost": 0.0}),
        Lever("no actuator lag in the model", {"actuator_tau": None}),
    ),
}
"""Components by task, each removed from our preset."""

ON: dict[str, tuple[Lever, ...]] = {
    "hover": (
        Lever("**as printed**"),
        Lever("+ disturbance observer alone", method="base-do"),
        Lever("+ frame", {"adapt": {"frame": "gravity"}}),
        Lever("+ regression", {"adapt": REGRESSION}),
        Lever("+ bursts, one Adam", {"adapt": {**SHORT_UPDATES, "optimiser": "carried"}}),
        Lever("+ starts from flight", {"adapt": {"task_starts": 2}}),
        Lever("+ sharp reward", {"reward": "l2"}),
        Lever("+ past commands and delay", {"command_history": 2, "delay_ticks": 1}),
    ),
    "track": (
        Lever("**as printed**"),
        Lever("+ regression", {"adapt": REGRESSION}),
        Lever("+ bursts, one Adam", {"adapt": {**SHORT_UPDATES, "optimiser": "carried"}}),
        Lever("+ starts from flight", {"adapt": {"task_starts": 2}}),
        Lever("+ steeper reward", {"reward": "l2"}),
        Lever("+ reference seen ahead", {"track": {"observation": "preview"}}),
        Lever("+ lag, past commands and delay", {"actuator_tau": 0.033, "command_history": 2, "delay_ticks": 1}),
    ),
}
"""Components by task, each added to the paper's preset."""
