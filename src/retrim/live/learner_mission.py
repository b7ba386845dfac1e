"""Mission, which describes a flight to learners on another machine."""

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from ..adapt.updates import Layer
from ..config.loading import parse
from ..config.trust import check_trust
from ..errors import MessageError, excerpt
from ..onboard.topics import INPUT_TOPICS, LAYERS, MOST_BYTES, OUTPUT_TOPICS
from ..transport.message import describe, pack_arrays, unpack_arrays

LOCAL = re.compile(r"\.(csv|toml)(:|\+|$)", re.IGNORECASE)


@dataclass(frozen=True)
class LearnerMission:
    """Describes one flight to its learners."""

    number: int
    """Number of the mission; an increase restarts the policy learner from a new ``start``."""
    reference: str | None
    seed: int
    base: str
    """Hash of the flight's controller."""
    layers: tuple[Layer, ...]
    floor: int
    """Policy version; updates up to this version are older than ``start``."""
    capacities: Mapping[str, int]
    """Maximum message length of each topic [bytes]."""
    start: bytes
    """Content of the file with the preset and the learned state from before the flight."""

    @classmethod
    def of(cls, number: int, reference: str | None, seed: int, base: str, layers: tuple[Layer, ...],
           floor: int, capacities: Mapping[str, int], start: Path) -> "LearnerMission":  # fmt: skip
        """Return the mission of a flight whose learners start from a file."""
        topic_sizes = {topic: size for topic, size in capacities.items() if topic in (*OUTPUT_TOPICS, *INPUT_TOPICS)}
        return cls(number, reference, seed, base, layers, floor, topic_sizes, start.read_bytes())

    def check(self, trust: Collection[str]) -> None:
        """Check that the mission uses only Python names that the user of this machine trusts.

        Args:
            trust: Trusted Python names, e.g. ``mine:task``.

        Raises:
            MessageError: ``start`` does not contain a learner state, or the mission names a file on this machine.
            ConfigError: The preset cannot be used, or a Python name is not trusted.
        """
        header = describe(self.start, kind="learnt", source="mission")
        preset = parse(header.get("preset", ""), source="mission, preset")
        check_trust((preset, self.reference), trust, source="mission")
        references = (self.reference or "", "" if preset.track is None else preset.track.reference)
        if files := [name for name in (*references, str(preset.vehicle)) if LOCAL.search(name)]:
            raise MessageError(f"mission: names a file of this machine, {excerpt(files[0])}; built-in names only")

    def pack(self) -> bytes:
        """Return the bytes; the inverse of :meth:`unpack`."""
        fields = {name: value for name, value in vars(self).items() if name != "start"}
        about = {"fields": json.dumps(fields), "bytes": str(len(self.start))}
        return pack_arrays({"start": np.frombuffer(self.start, dtype=np.uint8)}, kind="mission", about=about)

    @classmethod
    def unpack(cls, data: bytes) -> "LearnerMission":
        """Read a mission.

        Raises:
            MessageError: The bytes are not a mission.
        """
        header = describe(data, kind="mission", source="mission")
        try:
            fields, length = json.loads(header["fields"]), int(header["bytes"][:12])
            layers = cast("tuple[Layer, ...]", tuple(layer for layer in LAYERS if layer in fields["layers"]))
            capacities = {str(topic): int(size) for topic, size in fields["capacities"].items()}
            reference = None if fields["reference"] is None else str(fields["reference"])
            number, seed, base = int(fields["number"]), int(fields["seed"]), str(fields["base"])
            floor = int(fields["floor"])
        except (KeyError, ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
            raise MessageError(f"mission: a field is missing or wrong ({error})") from error
        if not set(capacities) <= {*OUTPUT_TOPICS, *INPUT_TOPICS} or not all(
            0 < size <= MOST_BYTES for size in capacities.values()
        ):
            raise MessageError("mission: topics that no flight has, or messages that are too long")
        if not 0 <= length <= MOST_BYTES:
            raise MessageError(f"mission: a file of {length} bytes")
        arrays = unpack_arrays(data, {"start": np.empty(length, np.uint8)}, kind="mission", source="mission")
        return cls(number, reference, seed, base, layers, floor, capacities, arrays["start"].tobytes())
