"""Write a policy in another format, run the result and compare it with JAX."""

import tempfile
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..config.setup import Setup
from ..errors import ConfigError
from ..io.checkpoint import load_delta
from ..io.files import write_whole
from ..io.policies import load_policy
from ..runkit.reporter import Reporter
from .c_header import write_c
from .checking import ROWS, Parity, check_c, check_npz, check_onnx
from .npz_file import write_delta, write_npz
from .onnx_file import write_onnx
from .portable import Portable, commands, observations, portable_of

PARITY = 1e-5  # largest error of an exported policy, as a fraction of the command range
SPREAD = 1.5  # scale of the observations for the comparison, in units of their usual size


@dataclass(frozen=True)
class Format:
    """A format of exported policies."""

    suffix: str
    write: Callable[[Path, Portable], list[Path]]
    check: Callable[[Path, Portable, np.ndarray, np.ndarray], Parity | None]


FORMATS = {
    "npz": Format(".npz", write_npz, check_npz),
    "onnx": Format(".onnx", write_onnx, check_onnx),
    "c": Format(".h", write_c, check_c),
}


def export(
    policy: Path, to: str, out: Path | None, delta: Path | None, reporter: Reporter, *, trust: Collection[str] = ()
) -> list[Path]:
    """Write a policy in another format, and report the accuracy of the result.

    Args:
        policy: A policy, or the folder that contains one.
        to: A format; or ``delta``, to write only a low-rank delta.
        out: File to write; by default, ``policy`` or ``delta`` with the suffix of the format, in the current folder.
        delta: A low-rank delta to add to the policy.
        reporter: Reporter that receives the results.
        trust: Python names that the policy may refer to, for example ``mine:task``.

    Returns:
        The paths of the written files.

    Raises:
        ConfigError: There is no such format, another file has the name of an output, or the result differs from JAX.
        CheckpointError: A file cannot be used.
    """
    if to not in (*FORMATS, "delta"):
        raise ConfigError(f"--to {to}: must be {', '.join(FORMATS)} or delta")
    if to == "delta" and delta is None:
        raise ConfigError("--to delta writes a low-rank delta: give it as --delta delta.safetensors")
    suffix = ".npz" if to == "delta" else FORMATS[to].suffix
    path = out or Path(f"{'delta' if to == 'delta' else 'policy'}{suffix}")
    if path.suffix != suffix:
        raise ConfigError(f"--out {path}: the name must end with {suffix}")
    weights, preset = load_policy(policy, trust=trust)
    if to == "delta":
        assert delta is not None
        return write_delta(path, load_delta(delta, weights))
    if delta is not None:
        weights = load_delta(delta, weights).merged()
    portable = portable_of(weights, Setup.from_preset(preset))
    rows = SPREAD * observations(portable.sizes[0], ROWS, seed=1)
    with tempfile.TemporaryDirectory() as folder:  # the target is replaced only after the check
        staged = FORMATS[to].write(Path(folder) / path.name, portable)
        result = FORMATS[to].check(staged[0], portable, rows, commands(weights, rows))
        contents = {path.with_name(each.name): each.read_bytes() for each in staged}
    if result is not None and not result.worst <= PARITY:
        raise ConfigError(
            f"{path}: {result.by} deviates from JAX by {result.worst:.1e} of the command range; nothing was written"
        )
    for each, content in contents.items():
        if each != path and each.exists() and (not each.is_file() or each.read_bytes() != content):
            raise ConfigError(f"{each} already exists, and is not the runner of this release: move it, or choose --out")
    for each, content in contents.items():
        write_whole(each, content)
    paths = list(contents)
    if result is None:
        reporter.say(f"{path} was not run: there is nothing here that runs it")
        return paths
    reporter.say(
        f"{result.by} and JAX: {result.worst:.1e} of the command range at most, on {len(rows)} observations; "
        f"{1e6 * result.step_s:.1f} µs a step"
    )
    if portable.observation is None:
        reporter.say(f"a {preset.task} policy does not see the state alone: its observation is yours to compute")
    return paths
