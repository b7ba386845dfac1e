"""Digests of the files that the names in presets and scenarios refer to."""

import sys
from pathlib import Path

from ..config.presets import Preset
from ..config.scenario import Scenario
from ..io.digests import file_digest


def file_digests(*names: str | None) -> dict[str, str]:
    """Return digests of the files that names refer to: CSV files, and the modules in ``module:name``.

    Args:
        *names: Names of any kind, or several joined by ``+``. Their modules must have been imported.
    """
    result = dict[str, str]()
    for part in (part for name in names if name for part in name.split("+")):
        head = part.partition(":")[0].partition("=")[0]
        path = Path(getattr(sys.modules.get(head) if ":" in part else None, "__file__", None) or head)
        if path.is_file():
            result[part] = file_digest(path)
    return result


def preset_names(preset: Preset) -> list[str | None]:
    """Return the names in a preset that may refer to a file."""
    reference = None if preset.track is None else preset.track.reference
    vehicle = preset.vehicle if isinstance(preset.vehicle, str) else None
    learning = (preset.adapt.residual, preset.adapt.learner, preset.adapt.optimiser, preset.pretrain.network)
    return [preset.task, *learning, reference, vehicle]


def scenario_names(scenario: Scenario) -> list[str | None]:
    """Return the names in a scenario that may refer to a file."""
    vehicle = scenario.vehicle if isinstance(scenario.vehicle, str) else None
    return [scenario.plant, scenario.sensors, scenario.disturbance, scenario.reference, vehicle]
