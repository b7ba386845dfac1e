"""Export NPZ files: the arrays of a policy, with a runner in the same folder, or only a low-rank delta."""

import json
from importlib.resources import files
from pathlib import Path

import numpy as np

from ..control.lora import LoraPolicy
from ..io.checkpoint import fingerprint
from ..io.files import npz_bytes, write_whole
from .portable import Portable

RUNNER = "runner.py"


def write_npz(path: Path, policy: Portable) -> list[Path]:
    """Write a policy, with the runner in the same folder; return both paths."""
    runner, code = path.with_name(RUNNER), files(__package__).joinpath(RUNNER).read_bytes()
    about = {**policy.about, "layers": len(policy.layers), "observation": policy.observation}
    arrays = {f"w{i}": w for i, (w, _) in enumerate(policy.layers)} | {
        f"b{i}": b for i, (_, b) in enumerate(policy.layers)
    }
    arrays |= {name: getattr(policy, name) for name in ("low", "high", "y0", "test_observations", "test_commands")}
    _write(path, arrays, about)
    write_whole(runner, code)
    return [path, runner]


def write_delta(path: Path, policy: LoraPolicy) -> list[Path]:
    """Write the delta of a low-rank policy without the base policy; return the path in a list."""
    arrays = {f"down{i}": np.asarray(thin.down, np.float32) for i, thin in enumerate(policy.delta)}
    arrays |= {f"up{i}": np.asarray(thin.up, np.float32) for i, thin in enumerate(policy.delta)}
    _write(path, arrays | {"shift": np.asarray(policy.shift, np.float32)},
           {"base": fingerprint(policy.base), "scale": float(policy.scale)})  # fmt: skip
    return [path]


def _write(path: Path, arrays: dict[str, np.ndarray], about: dict[str, object]) -> None:
    write_whole(path, npz_bytes({"about": np.array(json.dumps(about)), **arrays}))
