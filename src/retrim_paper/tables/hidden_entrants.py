"""The methods of the gauntlet of hidden vehicles, and the vehicle files that they receive."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from retrim.config.hidden_vehicles import HiddenVehicle
from retrim.config.presets import Preset
from retrim.errors import ConfigError

VehicleFile = Literal["none", "wrong", "true", "trained"]
"""Vehicle file of a method: none; one whose values are wrong by up to a factor of two; the true one; or the true one
also in training, with one policy per vehicle."""
KNOWLEDGE: dict[VehicleFile, str] = {
    "none": "not known", "wrong": "wrong by up to two", "true": "known", "trained": "known, own policy"
}  # fmt: skip
"""Cells of the table."""
OPPONENTS = ("base", "base-do", "geometric-i", "indi")


@dataclass(frozen=True)
class Entrant:
    """A preset and a method in the benchmark."""

    preset: str
    method: str
    file: VehicleFile = "none"
    once: bool = False
    """Whether the method flies each vehicle once, with the first training seed, since it computes for a long time."""

    @property
    def label(self) -> str:
        """Title of the map."""
        if self.file == "none":
            return f"{self.preset} {self.method}"
        return f"{self.method}, {'own policy' if self.file == 'trained' else f'{self.file} file'}"

    def inform(self, preset: Preset, vehicle: HiddenVehicle) -> Preset:
        """Return the preset with the vehicle file of the entrant, if it receives one."""
        if self.file == "none":
            return preset
        return replace(preset, vehicle=vehicle.wrong_spec if self.file == "wrong" else vehicle.spec)


ENTRANTS: dict[str, tuple[Entrant, ...]] = {
    task: (
        *(Entrant(f"{task}/retrim", method) for method in OPPONENTS),
        Entrant(f"{task}/retrim", "indi", "wrong"),
        Entrant(f"{task}/retrim", "indi", "true"),
        *(Entrant(f"{task}/any", method) for method in ("base", "base-do", "base-id")),
        Entrant(f"{task}/any", "base-id", "wrong"),
        *extra,
    )
    for task, extra in {
        "hover": (
            Entrant("hover/retrim", "l1-mpc", once=True),
            Entrant("hover/retrim", "base-do", "trained", once=True),
            Entrant("hover/retrim", "full", "trained", once=True),
        ),
        "track": (),
    }.items()
}
"""Entrants of the published pages. Those that compute for a long time fly hover only, where they take seconds per
vehicle."""


def entrants_of(task: str, preset: str, methods: Sequence[str], file: VehicleFile = "none") -> tuple[Entrant, ...]:
    """Return the entrants for a command: those on the published page, or the given methods with one preset.

    Args:
        task: Task of the preset.
        preset: Preset name, or file.
        methods: Methods to fly; if empty, the published entrants are returned.
        file: Vehicle file of the given methods.

    Raises:
        ConfigError: There is no such benchmark for the task, or a file is given without methods.
    """
    if task not in ENTRANTS:
        raise ConfigError(f"preset {preset!r} is for {task}; hidden vehicles are flown for {', '.join(ENTRANTS)}")
    if file != "none" and not methods:
        raise ConfigError(f"--file {file} needs --methods; without them, the published entrants are flown")
    return tuple(Entrant(preset, method, file) for method in methods) if methods else ENTRANTS[task]
