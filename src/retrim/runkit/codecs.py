"""Codecs of a store: JSON values and rows, pytrees, policies, and sections of documents."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random

from ..config.command_paths import with_delay
from ..config.loading import dump
from ..config.presets import Preset
from ..config.trust import python_names
from ..control.policy import AbstractPolicy
from ..errors import CheckpointError
from ..io.digests import file_digest, text_digest
from ..io.files import write_whole
from ..io.policies import load_policy, save_policy
from ..transport import wire
from .document import TableSection
from .store import Codec

T = TypeVar("T")
Rows = Sequence[dict[str, Any]]


def json_codec(kind: str, suffix: str = ".json") -> Codec[Any]:
    """Return the codec of a JSON value; the file contains its kind and its digest."""

    def write(path: Path, value: Any) -> None:
        content = {"kind": kind, "digest": text_digest(json.dumps(value)), "value": value}
        write_whole(path, json.dumps(content) + "\n")

    def read(path: Path) -> Any:
        content = json.loads(path.read_text())
        if content["kind"] != kind:
            raise CheckpointError(f"{path}: holds a {content['kind']!r}, expected a {kind!r}")
        if content["digest"] != text_digest(json.dumps(content["value"])):
            raise CheckpointError(f"{path}: the digest does not match; the file was damaged or edited")
        return content["value"]

    return Codec(suffix, write, read)


def rows_codec() -> Codec[Sequence[Any]]:
    """Return the codec of rows, one line of JSON each, for other programs, too; other lines are read as None."""

    def row(line: str) -> Any:
        try:
            return json.loads(line)
        except (ValueError, RecursionError):
            return None

    return Codec(
        ".jsonl",
        lambda path, rows: write_whole(path, "".join(json.dumps(each) + "\n" for each in rows)),
        lambda path: [row(line) for line in path.read_text(errors="replace").splitlines()],
    )


def tree_codec(like: T, kind: str, about: Mapping[str, str] | None = None) -> Codec[T]:
    """Return the codec of a pytree's arrays as safetensors; random keys are written as their key data.

    Args:
        like: Tree with the same structure; it supplies the leaves that are not arrays.
        kind: Kind of content.
        about: Further metadata for readers of the file.
    """
    arrays, rest = eqx.partition(like, eqx.is_array)

    def read(path: Path) -> T:
        numbers = wire.unpack(path.read_bytes(), _numbers(like), kind=kind, source=str(path))
        leaves = jax.tree.map(lambda old, new: random.wrap_key_data(new) if _is_key(old) else new, arrays, numbers)
        tree: T = eqx.combine(leaves, rest)
        return tree

    return Codec(
        ".safetensors",
        lambda path, tree: write_whole(path, wire.pack(_numbers(tree), kind=kind, about=about or {})),
        read,
    )


def policy_codec(preset: Preset) -> Codec[AbstractPolicy]:
    """Return the codec of policies of a preset, in the format that `retrim fly` reads."""

    def read(path: Path) -> AbstractPolicy:
        policy, other = load_policy(path, trust=python_names(preset))
        if dump(with_delay(other)) != dump(with_delay(preset)):  # a file contains the delay of its vehicle file
            raise CheckpointError(f"{path}: its preset {other.name!r} is not that of the run, {preset.name!r}")
        return policy

    return Codec(".safetensors", lambda path, policy: save_policy(path, policy, preset), read)


def section_codec(folder: Path) -> Codec[tuple[TableSection, Rows]]:
    """Return the codec of document sections with their rows of results.

    A digest in the file detects that another run has overwritten the picture of a section.

    Args:
        folder: Folder of the pictures.
    """
    plain = json_codec("section")

    def write(path: Path, value: tuple[TableSection, Rows]) -> None:
        section, rows = value
        picture = None if section.picture is None else [section.picture.name, file_digest(section.picture)]
        plain.write(path, {"section": dataclasses.asdict(section) | {"picture": picture}, "rows": rows})

    def read(path: Path) -> tuple[TableSection, Rows]:
        content = plain.read(path)
        section, picture = content["section"], None
        if section["picture"] is not None:
            name, digest = section["picture"]
            picture = folder / name
            if not picture.is_file() or file_digest(picture) != digest:
                raise CheckpointError(f"{path}: its picture {name} was overwritten or removed")
        lines = tuple(tuple(row) for row in section["rows"])
        columns, title, about = tuple(section["columns"]), section["title"], section["about"]
        return TableSection(columns, lines, title, about, picture), content["rows"]

    return Codec(plain.suffix, write, read)


def _numbers(tree: Any) -> Any:
    """Return a tree's arrays, with random keys as key data."""
    arrays = eqx.filter(tree, eqx.is_array)
    return jax.tree.map(lambda leaf: random.key_data(leaf) if _is_key(leaf) else leaf, arrays)


def _is_key(leaf: Any) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key))
