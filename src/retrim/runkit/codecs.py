"""Codecs of a store: JSON values and rows, pytrees, policies, and sections of documents."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random

from ..config.loading import dump
from ..config.presets import Preset
from ..config.trust import python_names
from ..control.policy import AbstractPolicy
from ..errors import CheckpointError
from ..io.digests import file_digest, text_digest
from ..io.files import write_whole
from ..io.trained import load_policy, save_policy
from ..transport import wire
from .document import TableSection

T = TypeVar("T")
Rows = Sequence[dict[str, Any]]


@dataclass(frozen=True)
class JsonCodec:
    """One JSON value with its kind and digest."""

    kind: str
    suffix: str = ".json"

    def write(self, path: Path, value: Any) -> None:
        """Write a value of numbers, strings, lists and dictionaries."""
        content = {"kind": self.kind, "digest": text_digest(json.dumps(value)), "value": value}
        write_whole(path, json.dumps(content) + "\n")

    def read(self, path: Path) -> Any:
        """Return the value."""
        content = json.loads(path.read_text())
        if content["kind"] != self.kind:
            raise CheckpointError(f"{path}: holds a {content['kind']!r}, expected a {self.kind!r}")
        if content["digest"] != text_digest(json.dumps(content["value"])):
            raise CheckpointError(f"{path}: the digest does not match; the file was damaged or edited")
        return content["value"]


@dataclass(frozen=True)
class RowsCodec:
    """Rows of results, one line of JSON each, for other programs, too; lines that are not JSON are read as None."""

    suffix: str = ".jsonl"

    def write(self, path: Path, rows: Sequence[Any]) -> None:
        """Write the rows."""
        write_whole(path, "".join(json.dumps(row) + "\n" for row in rows))

    def read(self, path: Path) -> Sequence[Any]:
        """Return the rows."""
        return [_json_or_none(line) for line in path.read_text(errors="replace").splitlines()]


def _json_or_none(line: str) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


@dataclass(frozen=True)
class TreeCodec(Generic[T]):
    """The arrays of a pytree as safetensors; random keys are written as their key data."""

    like: T
    """Tree with the same structure; it supplies the leaves that are not arrays."""
    kind: str
    about: Mapping[str, str] = field(default_factory=dict)
    """Further metadata for readers of the file."""
    suffix: str = ".safetensors"

    def write(self, path: Path, tree: T) -> None:
        """Write the arrays."""
        write_whole(path, wire.pack(_numbers(tree), kind=self.kind, about=self.about))

    def read(self, path: Path) -> T:
        """Return the tree."""
        numbers = wire.unpack(path.read_bytes(), _numbers(self.like), kind=self.kind, source=str(path))
        arrays, rest = eqx.partition(self.like, eqx.is_array)
        leaves = jax.tree.map(lambda old, new: random.wrap_key_data(new) if _is_key(old) else new, arrays, numbers)
        tree: T = eqx.combine(leaves, rest)
        return tree


def _numbers(tree: Any) -> Any:
    """Return a tree's arrays, with random keys as key data."""
    arrays = eqx.filter(tree, eqx.is_array)
    return jax.tree.map(lambda leaf: random.key_data(leaf) if _is_key(leaf) else leaf, arrays)


def _is_key(leaf: Any) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key))


@dataclass(frozen=True)
class PolicyCodec:
    """A policy with its preset, as `retrim fly` reads it."""

    preset: Preset
    suffix: str = ".safetensors"

    def write(self, path: Path, policy: AbstractPolicy) -> None:
        """Write the policy."""
        save_policy(path, policy, self.preset)

    def read(self, path: Path) -> AbstractPolicy:
        """Return the policy."""
        policy, preset = load_policy(path, trust=python_names(self.preset))
        if dump(preset) != dump(self.preset):
            raise CheckpointError(f"{path}: its preset {preset.name!r} is not that of the run, {self.preset.name!r}")
        return policy


@dataclass(frozen=True)
class SectionCodec:
    """A section of a document with its rows of results; the digest of its picture detects another run's picture."""

    folder: Path
    """Folder of the pictures."""
    suffix: str = ".json"

    def write(self, path: Path, value: tuple[TableSection, Rows]) -> None:
        """Write the section and its rows; the picture is already in the folder."""
        section, rows = value
        picture = None if section.picture is None else [section.picture.name, file_digest(section.picture)]
        content = {"section": dataclasses.asdict(section) | {"picture": picture}, "rows": rows}
        JsonCodec("section").write(path, content)

    def read(self, path: Path) -> tuple[TableSection, Rows]:
        """Return the section and its rows."""
        content = JsonCodec("section").read(path)
        section, picture = content["section"], None
        if section["picture"] is not None:
            name, digest = section["picture"]
            picture = self.folder / name
            if not picture.is_file() or file_digest(picture) != digest:
                raise CheckpointError(f"{path}: its picture {name} was overwritten or removed")
        lines = tuple(tuple(row) for row in section["rows"])
        columns, title, about = tuple(section["columns"]), section["title"], section["about"]
        return TableSection(columns, lines, title, about, picture), content["rows"]
