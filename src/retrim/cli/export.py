"""``retrim export``: export a policy."""

import threading
from collections.abc import Callable
from pathlib import Path

import tyro

from ..export.export import export as exported
from .console import RichReporter, Trust, show_paths


def export(
    policy: tyro.conf.Positional[Path], to: str = "npz", delta: Path | None = None, trust: Trust = (),
    out: Path | None = None,
) -> Callable[[threading.Event], int]:  # fmt: skip
    """Write a policy for a computer without JAX, and compare its commands with those of JAX on 10,000 observations.

    Args:
        policy: A policy.safetensors, or the folder that contains one.
        to: Format: npz (arrays, with a runner that needs only NumPy), onnx, c (one C99 header, without allocation), or
            delta (only a low-rank delta, for the runner).
        delta: A low-rank delta.safetensors to add to the policy.
        trust: Python name that a file may contain, such as mine:task; its code is run. Repeat the option for each name.
        out: File to write; by default policy.npz, policy.onnx, policy.h or delta.npz in the current folder.
    """

    def execute(stop: threading.Event) -> int:
        show_paths(exported(policy, to, out, delta, RichReporter(), trust=trust))
        return 0

    return execute
