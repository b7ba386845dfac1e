"""Packs flights into one NPZ file, bit for bit, without their learner states."""

import io
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..runkit.flights import Flight, FlightSpec
from ..runtime.events import Event
from ..runtime.flight import Log, States

SCALARS = ("vehicle", "metric", "steady_seconds")


def packed(flights: Sequence[Flight]) -> bytes:
    """Return flights as an NPZ file.

    Args:
        flights: The flights; the file does not contain their specifications.
    """
    arrays, about = dict[str, Any](), list[dict[str, Any]]()
    for i, flight in enumerate(flights):
        log = flight.log
        parts: dict[str, Any] = {"t": log.t, "u": log.u, "age": log.age}
        parts |= {"error": flight.error, "cross": flight.cross, "target": flight.target}
        for name, states in (("true", log.true), ("measured", log.measured)):
            parts |= {f"{name}.{part}": value for part, value in states._asdict().items()}
        arrays |= {f"{i}.{name}": value for name, value in parts.items() if value is not None}
        scalars = {name: getattr(flight, name) for name in SCALARS}
        about.append({"flight": scalars, "dt": log.dt, "terminated": log.terminated, "events": log.events})
    file = io.BytesIO()
    np.savez(file, about=np.array(json.dumps(about)), **arrays)
    return file.getvalue()


def unpacked(data: bytes, specs: Sequence[FlightSpec]) -> list[Flight]:
    """Return the flights from a file that :func:`packed` made.

    Args:
        data: Content of the file.
        specs: Specifications of the flights.

    Raises:
        ValueError: The file has a different number of flights. For an invalid file, NumPy's reader raises an error.
    """
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        arrays: dict[str, np.ndarray] = dict(file)
    about = json.loads(str(arrays.pop("about")))
    return [
        _flight({name.partition(".")[2]: value for name, value in arrays.items() if name.startswith(f"{i}.")}, spec, a)
        for i, (spec, a) in enumerate(zip(specs, about, strict=True))
    ]


def _flight(parts: dict[str, np.ndarray], spec: FlightSpec, about: dict[str, Any]) -> Flight:
    true, measured = (States(*(parts[f"{name}.{part}"] for part in States._fields)) for name in ("true", "measured"))
    events = tuple(Event(*event) for event in about["events"])
    cross, target, age = parts.get("cross"), parts.get("target"), parts["age"]
    old = age if age.ndim else float(age)
    log = Log(parts["t"], true, measured, parts["u"], about["dt"], about["terminated"], events, old)
    return Flight(spec, log=log, error=parts["error"], cross=cross, target=target, **about["flight"])
