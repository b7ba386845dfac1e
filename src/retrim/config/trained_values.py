"""Values of a preset that the weights of a policy depend on, which a flight cannot change."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..errors import ConfigError
from .presets import Preset, Vision

WEIGHT_KEYS = ("task", "vehicle", "dt", "axes", "command_history")
ABSOLUTE = ("blind", "both")  # observations of the position itself, not relative to the reference
CONDITION_KEYS = ("occlusion", "pixel_noise", "dropout")
"""Values of the table [vision] that are conditions of a flight; its other values belong to the weights."""


def same_policy(original: Preset, candidate: Preset, config: Path) -> Preset:
    """Return ``candidate``, unless it changes a value that the weights depend on.

    Args:
        original: Preset of the policy.
        candidate: Preset with the values of a file.
        config: The file, for the message.

    Raises:
        ConfigError: ``candidate`` changes such a value.
    """
    before, after = dict(_weight_values(original)), dict(_weight_values(candidate))
    for name in {**before, **after}:
        if before.get(name) != after.get(name):
            raise ConfigError(
                f"{config}: {name} = {after.get(name)!r}, but the policy was trained with {before.get(name)!r}"
            )
    if original.pretrain != candidate.pretrain:
        raise ConfigError(f"{config}: [pretrain] cannot change for a policy that is trained")
    return candidate


def _weight_values(preset: Preset) -> Iterator[tuple[str, Any]]:
    """Yield the values of a preset that the weights depend on, with their names."""
    for name in WEIGHT_KEYS:
        yield name, getattr(preset, name)
    family = preset.family and dataclasses.replace(preset.family, excitation=False)  # independent of the excitation
    yield "family", family
    if preset.track is not None:
        yield "track.observation", preset.track.observation
        if preset.track.observation == "blind":
            yield "track.reference", preset.track.reference
    if preset.task == "vision" or (preset.track is not None and preset.track.observation in ABSOLUTE):
        yield "goal", preset.goal
    if preset.task == "vision":
        for field in dataclasses.fields(Vision):
            if field.name not in CONDITION_KEYS:
                yield f"vision.{field.name}", getattr(preset.vision or Vision(), field.name)
