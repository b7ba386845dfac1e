"""Writes a flight for the rerun viewer, which shows the vehicle in 3-D and plots errors, commands and events.

Writing needs the extra ``rerun``. All data are on one timeline, ``flight``, in seconds from the start of the flight.
"""

import tempfile
import uuid
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .recording import Recording, quaternions

ARM = 0.1  # size of the cross that represents the vehicle [m]
AXES = ("x", "y", "z")


def write_rrd(path: Path, flight: Recording) -> None:
    """Write a flight for rerun; the file appears once it is complete."""
    import rerun as rr
    from rerun import blueprint as rrb

    plots = [
        rrb.TimeSeriesView(origin=f"/{origin}", name=name)
        for origin, name in (
            ("error", "error [m]"),
            ("command/thrust", "thrust [m/s²]"),
            ("command/rates", "body rates [rad/s]"),
            ("age", "age of the data of the policy [s]"),
        )
    ]
    beside = rrb.Vertical(*plots, rrb.TextLogView(origin="/events", name="events"))
    layout = rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin="/world", name="flight"), beside))
    with tempfile.TemporaryDirectory(dir=path.parent) as place:
        part = Path(place) / path.name
        stream = rr.RecordingStream("retrim", recording_id=uuid.uuid4())
        stream.save(part, default_blueprint=layout)
        _write(rr, stream, flight)
        stream.flush()
        stream.disconnect()
        part.replace(path)


def _write(rr: Any, stream: Any, flight: Recording) -> None:
    def over_time(entity: str, columns: Any, t: Iterable[float] = flight.t) -> None:
        stream.send_columns(entity, indexes=[rr.TimeColumn("flight", duration=t)], columns=columns)

    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("world/flown", rr.LineStrips3D([flight.true[:, :3]], colors=[0, 114, 178]), static=True)
    cross = [[[-ARM, -ARM, 0], [ARM, ARM, 0]], [[-ARM, ARM, 0], [ARM, -ARM, 0]], [[0, 0, 0], [0, 0, ARM]]]
    for name, x, colour in (("vehicle", flight.true, [0, 114, 178]), ("measured", flight.measured, [150, 150, 150])):
        stream.log(f"world/{name}", rr.LineStrips3D(cross, colors=colour), static=True)
        over_time(f"world/{name}", rr.Transform3D.columns(translation=x[:, :3], quaternion=quaternions(x)))
    if flight.target is not None:
        stream.log("world/reference", rr.LineStrips3D([flight.target], colors=[0, 158, 115]), static=True)
        over_time("world/target", rr.Points3D.columns(positions=flight.target))
    over_time("error", rr.Scalars.columns(scalars=flight.error))
    over_time("command/thrust", rr.Scalars.columns(scalars=flight.command[:, 0]))
    for k, axis in enumerate(AXES):
        over_time(f"command/rates/{axis}", rr.Scalars.columns(scalars=flight.command[:, 1 + k]))
    if flight.policy_age is not None:
        over_time("age/policy", rr.Scalars.columns(scalars=flight.policy_age))
    entries = _list_entries(flight)
    if entries:
        times, texts = zip(*entries, strict=True)
        over_time("events", rr.TextLog.columns(text=texts), np.asarray(times))


def _list_entries(flight: Recording) -> list[tuple[float, str]]:
    """Return the events and each change of the active controller, with times [s], in order."""
    entries = [(event.t, f"{event.kind}: {event.note}") for event in flight.events]
    controllers = flight.controllers or ()
    before: str | None = None
    for t, name in zip(flight.t.tolist(), controllers, strict=False):
        if name != before:
            entries.append((t, f"flown by {name}"))
        before = name
    return sorted(entries)
