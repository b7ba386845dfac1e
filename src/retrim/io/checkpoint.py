"""Reads and writes policy files, which contain weights, limits, a description and a checksum."""

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import random

from ..control.lora import LoraPolicy
from ..control.policy import AbstractPolicy, Policy
from ..errors import CheckpointError, MessageError
from ..physics.vehicle import small
from ..transport import wire
from .files import read_bounded, write_whole
from .releases import this_release
from .sanity import check_policy

MAX_WIDTH, MAX_LAYERS = 16_384, 16
NETWORK = "network"
"""Architecture of a policy that is not a perceptron; the function named in the policy's preset builds the network."""


def write_policy(path: str | Path, policy: AbstractPolicy, about: Mapping[str, str]) -> None:
    """Write a policy, and create the file's folder if necessary.

    Args:
        path: The file.
        policy: Policy to write.
        about: Header fields, for example a preset; the architecture and this package's version are added.
    """
    header = {**about, "architecture": architecture(policy), "version": this_release()}
    write_whole(Path(path), wire.pack(policy, kind="policy", about=header))


def read_policy(
    path: str | Path, network: Callable[[dict[str, str]], AbstractPolicy] | None = None
) -> tuple[AbstractPolicy, dict[str, str]]:
    """Read a policy from a file, or from a folder that contains ``policy.safetensors``.

    Args:
        path: The file or folder.
        network: Maps the file's header to the shapes of a policy that is not a perceptron. By default, only perceptrons
            are read.

    Returns:
        The policy, and the file's header.

    Raises:
        CheckpointError: The file is missing, truncated, damaged or of a different kind, the policy's weights or
            commands are not finite or are too large, or its limits do not enclose hover.
    """
    path = Path(path)
    file = path / "policy.safetensors" if path.is_dir() else path
    if file.suffix == ".toml":
        raise CheckpointError(
            f"{file}: a TOML file is not a policy; `retrim pretrain hover --vehicle {file}` makes one"
        )
    data = read_bounded(file, "`retrim pretrain hover --out DIR` makes one")
    try:
        if wire.kind_of(data, source=str(file)) == "learnt":
            raise CheckpointError(f"{file}: holds a learner state; continue from it with `retrim fly --resume`")
        header = wire.describe(data, kind="policy", source=str(file))
        sizes, like = header.get("architecture", ""), None
        if sizes == NETWORK and network is not None:
            like = network(header)
        policy = wire.unpack(data, like or policy_like(sizes, source=str(file)), kind="policy", source=str(file))
    except MessageError as error:
        raise CheckpointError(str(error)) from error
    check_policy(policy, source=str(file))
    return policy, header


def policy_like(sizes: str, *, source: str) -> Policy:
    """Return a policy's shapes from its architecture, for example ``15-512-512-4``.

    Raises:
        CheckpointError: The text does not describe a policy's architecture.
    """
    try:
        widths = [int(word) for word in sizes.split("-")]
    except ValueError:
        widths = []
    if sizes == NETWORK:
        raise CheckpointError(f"{source}: the network is not a perceptron; retrim.load_policy reads it with its preset")
    if not (3 <= len(widths) <= MAX_LAYERS and all(0 < n <= MAX_WIDTH for n in widths) and widths[-1] == 4):
        raise CheckpointError(f"{source}: architecture {sizes!r}, expected sizes as 15-512-512-4")
    like: Policy = jax.eval_shape(lambda: Policy.of(widths[0], small(), key=random.key(0), hidden=tuple(widths[1:-1])))
    return like


def architecture(policy: AbstractPolicy) -> str:
    """Return a perceptron's layer sizes, for example ``15-512-512-4``; ``network`` for any other network."""
    layers = policy.linear_layers()
    if not layers:
        return NETWORK
    return "-".join(str(n) for n in (layers[0].weight.shape[1], *(layer.weight.shape[0] for layer in layers)))


def fingerprint(policy: AbstractPolicy) -> str:
    """Return a hash of a policy's weights in single precision; the hash identifies the base of a low-rank delta."""
    digest = hashlib.sha256()
    for layer in policy.linear_layers():
        for leaf in (layer.weight, layer.bias):
            digest.update(np.asarray(leaf, dtype=np.float32, order="C").tobytes())
    return digest.hexdigest()


def save_delta(path: str | Path, policy: LoraPolicy) -> None:
    """Write a low-rank policy's learned delta without its base: about 50 kB for the paper's network.

    Args:
        path: The file; its folder is created if necessary.
        policy: Delta and base; the file identifies the base by a hash.

    Raises:
        OSError: The file cannot be written.
    """
    about = {"base": fingerprint(policy.base), **lora_header(policy), "version": this_release()}
    write_whole(Path(path), wire.pack((policy.delta, policy.shift), kind="delta", about=about))


def load_delta(path: str | Path, base: AbstractPolicy) -> LoraPolicy:
    """Read a delta and combine it with its base; to fly, call ``.merged()`` on the result.

    Args:
        path: The file.
        base: The policy for which the delta was trained.

    Raises:
        CheckpointError: The file is missing, damaged, of a different kind or for a different base, or the merged policy
            cannot be flown.
    """
    path = Path(path)
    if not isinstance(base, Policy):
        raise CheckpointError(f"{path}: a low-rank delta needs a perceptron as its base")
    data = read_bounded(path, "`retrim fly --adapt lora --out DIR` makes a delta.safetensors")
    try:
        header = wire.describe(data, kind="delta", source=str(path))
        if header.get("base") != fingerprint(base):
            base_name = header.get("base", "unnamed")[:12]
            raise CheckpointError(
                f"{path}: made for a different base policy, {base_name}..., not for {fingerprint(base)[:12]}..."
            )
        like = lora_like(base, header, source=str(path))
        delta, shift = wire.unpack(data, (like.delta, like.shift), kind="delta", source=str(path))
    except MessageError as error:
        raise CheckpointError(str(error)) from error
    policy = LoraPolicy(base, delta, jnp.asarray(float(header["scale"]), dtype=base.layers[0].weight.dtype), shift)
    check_policy(policy.merged(), source=f"{path}, merged")
    return policy


def lora_header(policy: LoraPolicy) -> dict[str, str]:
    """Return the header fields that give the shapes of a low-rank policy."""
    ranks = "-".join(str(factors.down.shape[0]) for factors in policy.delta)
    return {"ranks": ranks, "scale": repr(float(policy.scale))}


def lora_like(base: Policy, header: Mapping[str, str], *, source: str) -> LoraPolicy:
    """Return the shapes of a low-rank policy on ``base`` from header fields.

    Raises:
        CheckpointError: The ranks or the scale are missing or invalid.
    """
    try:
        ranks, scale = tuple(map(int, header["ranks"].split("-"))), float(header["scale"])
        if not np.isfinite(scale):
            raise ValueError(f"scale {scale}")
        like: LoraPolicy = jax.eval_shape(
            lambda base: LoraPolicy.of(base, key=random.key(0), ranks=ranks, scale=scale), base
        )
    except (KeyError, ValueError) as error:
        raise CheckpointError(f"{source}: no usable ranks and scale of a low-rank delta ({error})") from error
    return like
