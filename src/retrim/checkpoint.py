"""Policies as files: weights, the preset that says how to fly them, and a checksum."""

import hashlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import random

from . import build, presets
from .adapt import wire
from .control.lora import LoraPolicy
from .control.policy import Policy
from .presets import Preset


class PolicyError(ValueError):
    """A policy file that must not be flown. The text names the file, what is wrong, and what was expected."""


def save_policy(path: str | Path, policy: Policy, preset: Preset) -> None:
    """Write ``policy`` and the preset it was trained with to ``path``; the folder is made if need be."""
    about = {"preset": presets.dump(preset), "task": preset.task, "architecture": _architecture(policy)}
    _write(Path(path), wire.pack(policy, kind="policy", about=about))


def load_policy(path: str | Path) -> tuple[Policy, Preset]:
    """Read a policy and its preset from a file, or from a folder that holds ``policy.safetensors``.

    Raises :class:`PolicyError` for a file that is missing, truncated, damaged, of another kind or architecture, or has
    weights that are not finite.
    """
    path = Path(path)
    file = path / "policy.safetensors" if path.is_dir() else path
    try:
        data = _read(file, "`retrim pretrain hover --out DIR` makes one")
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


def fingerprint(policy: Policy) -> str:
    """Of a policy's weights, in single precision: a delta belongs to one base."""
    digest = hashlib.sha256()
    for layer in policy.layers:
        for leaf in (layer.weight, layer.bias):
            digest.update(np.asarray(leaf, dtype=np.float32, order="C").tobytes())
    return digest.hexdigest()


def save_delta(path: str | Path, policy: LoraPolicy) -> None:
    """Write what a low-rank policy has learnt, without its base: about 50 kB for the paper's network."""
    ranks = "-".join(str(thin.down.shape[0]) for thin in policy.delta)
    about = {"base": fingerprint(policy.base), "ranks": ranks, "scale": repr(float(policy.scale))}
    _write(Path(path), wire.pack(policy.delta, kind="delta", about=about))


def load_delta(path: str | Path, base: Policy) -> LoraPolicy:
    """Read a delta and put it on ``base``; ``.plain()`` flies.

    Raises :class:`PolicyError` for a file that is missing, damaged or of another kind, and for another base.
    """
    path = Path(path)
    try:
        data = _read(path, "`retrim fly --adapt lora --out DIR` makes a delta.safetensors")
        header = wire.describe(data, kind="delta", source=str(path))
        if header.get("base") != fingerprint(base):
            raise PolicyError(f"{path}: made for another base policy, {header.get('base', 'unnamed')[:12]}..., not for "
                              f"{fingerprint(base)[:12]}...")  # fmt: skip
        ranks, scale = tuple(map(int, header["ranks"].split("-"))), float(header["scale"])
        like = jax.eval_shape(lambda: LoraPolicy.of(base, key=random.key(0), ranks=ranks, scale=scale))
        delta = wire.unpack(data, like.delta, kind="delta", source=str(path))
        return LoraPolicy(base, delta, jnp.asarray(scale, dtype=base.layers[0].weight.dtype))
    except (wire.WireError, OSError, KeyError, ValueError) as error:
        raise error if isinstance(error, PolicyError) else PolicyError(f"{path}: {error}") from error


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(data)
    partial.replace(path)  # an interrupted write leaves the old file


def _read(file: Path, advice: str) -> bytes:
    if not file.is_file():
        raise PolicyError(f"{file}: no such file; {advice}")
    if (size := file.stat().st_size) > wire.MAX_BYTES:
        raise PolicyError(f"{file}: {size} bytes, more than the {wire.MAX_BYTES} that are accepted")
    return file.read_bytes()


def _architecture(policy: Policy) -> str:
    """Sizes of the layers, as in 15-512-512-4."""
    return "-".join(str(n) for n in (policy.layers[0].weight.shape[1], *(l.weight.shape[0] for l in policy.layers)))
