"""Policies as files: weights, the preset that says how to fly them, and a checksum."""

from pathlib import Path

import jax
from jax import random

from . import build, presets
from .adapt import wire
from .control.policy import Policy
from .presets import Preset


class PolicyError(ValueError):
    """A policy file that must not be flown. The text names the file, what is wrong, and what was expected."""


def save_policy(path: str | Path, policy: Policy, preset: Preset) -> None:
    """Write ``policy`` and the preset it was trained with to ``path``; the folder is made if need be."""
    path = Path(path)
    about = {"preset": presets.dump(preset), "task": preset.task, "architecture": _architecture(policy)}
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(wire.pack(policy, kind="policy", about=about))
    partial.replace(path)  # an interrupted write leaves the old file


def load_policy(path: str | Path) -> tuple[Policy, Preset]:
    """Read a policy and its preset from a file, or from a folder that holds ``policy.safetensors``.

    Raises :class:`PolicyError` for a file that is missing, truncated, damaged, of another kind or architecture, or has
    weights that are not finite.
    """
    path = Path(path)
    file = path / "policy.safetensors" if path.is_dir() else path
    if not file.is_file():
        raise PolicyError(f"{file}: no such file; `retrim pretrain hover --out DIR` makes one")
    try:
        if (size := file.stat().st_size) > wire.MAX_BYTES:
            raise PolicyError(f"{file}: {size} bytes, more than the {wire.MAX_BYTES} that are accepted")
        data = file.read_bytes()
        header = wire.describe(data, kind="policy", source=str(file))
        preset = presets.parse(header.get("preset", ""), source=f"{file}, header, preset")
        like = jax.eval_shape(lambda: build.policy(preset, random.key(0)))
        wanted = _architecture(like)
        if header.get("architecture") != wanted:
            raise PolicyError(
                f"{file}: architecture {header.get('architecture')}, but its preset {preset.name!r} needs {wanted}"
            )
        return wire.unpack(data, like, kind="policy", source=str(file)), preset
    except (wire.WireError, presets.PresetError, OSError) as error:
        raise PolicyError(str(error)) from error


def _architecture(policy: Policy) -> str:
    """Sizes of the layers, as in 15-512-512-4."""
    return "-".join(str(n) for n in (policy.layers[0].weight.shape[1], *(l.weight.shape[0] for l in policy.layers)))
