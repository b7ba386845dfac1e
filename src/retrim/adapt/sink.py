"""Whoever watches a flight."""

import json
from pathlib import Path
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Sink(Protocol):
    """Receives every sample and every event. It must not block."""

    def state(self, sample: Any) -> None:
        """A :class:`retrim.adapt.plant.Sample`, once a tick."""
        ...

    def event(self, kind: str, **data: object) -> None:
        """Something happened: ``residual``, ``policy``, ``rejected``, ``skipped``."""
        ...


class JsonlSink:
    """Events as lines of JSON, written at once."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w")

    def state(self, sample: Any) -> None:
        """Ignored."""

    def event(self, kind: str, **data: object) -> None:
        """One line."""
        self._file.write(json.dumps({"event": kind, **data}) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
