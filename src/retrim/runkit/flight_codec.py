"""Codec of a store for flights: one NPZ file, bit for bit, without the learner states."""

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CheckpointError
from ..io.digests import text_digest
from ..io.files import npz_bytes, write_whole
from ..runtime.events import Event
from ..runtime.flight import Log, States
from .flights import Flight, FlightSpec
from .store import Codec

SCALARS = ("vehicle", "metric", "steady_seconds")


def flight_codec(specs: Sequence[FlightSpec]) -> Codec[Sequence[Flight]]:
    """Return the codec of the flights of given specifications, in their order."""

    def write(path: Path, flights: Sequence[Flight]) -> None:
        arrays, rows = dict[str, Any](), list[dict[str, Any]]()
        for i, flight in enumerate(flights):
            log = flight.log
            parts: dict[str, Any] = {"t": log.t, "u": log.u, "age": log.age, "phase": log.phase}
            parts |= {"error": flight.error, "cross": flight.cross, "target": flight.target}
            for name, states in (("true", log.true), ("measured", log.measured)):
                parts |= {f"{name}.{part}": value for part, value in states._asdict().items()}
            arrays |= {f"{i}.{name}": value for name, value in parts.items() if value is not None}
            scalars = {name: getattr(flight, name) for name in SCALARS}
            rows.append({"flight": scalars, "dt": log.dt, "terminated": log.terminated, "events": log.events})
        about = {"specs": _digest([flight.spec for flight in flights]), "flights": rows}
        write_whole(path, npz_bytes({"about": np.array(json.dumps(about)), **arrays}))

    def read(path: Path) -> Sequence[Flight]:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays: dict[str, np.ndarray] = dict(file)
        about = json.loads(str(arrays.pop("about")))
        if about["specs"] != _digest(specs):
            raise CheckpointError(f"{path}: holds flights of other specifications")
        parts = [dict[str, np.ndarray]() for _ in specs]
        for name, array in arrays.items():
            number, _, part = name.partition(".")
            parts[int(number)][part] = array
        return [_flight(*each) for each in zip(parts, specs, about["flights"], strict=True)]

    return Codec(".npz", write, read)


def _digest(specs: Sequence[FlightSpec]) -> str:
    return text_digest("\n".join(map(repr, specs)))


def _flight(parts: dict[str, np.ndarray], spec: FlightSpec, about: dict[str, Any]) -> Flight:
    true, measurement = (States(*(parts[f"{name}.{part}"] for part in States._fields)) for name in ("true", "measured"))
    events = tuple(Event(*event) for event in about["events"])
    cross, target, age = parts.get("cross"), parts.get("target"), parts["age"]
    log_age = age if age.ndim else float(age)
    ends = about["dt"], about["terminated"], events, log_age
    log = Log(parts["t"], true, measurement, parts["u"], *ends, parts.get("phase"))
    return Flight(spec, log=log, error=parts["error"], cross=cross, target=target, **about["flight"])
