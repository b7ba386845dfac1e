"""Reads a map's quantities from a file, as series in order of time."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import LogError
from .blackbox_csv import read_decoded
from .blackbox_file import read_blackbox
from .body_map import BodyMap
from .csv_file import read_csv
from .dataflash_file import read_dataflash
from .flights import FlightReader
from .log_map import METRES, SECONDS
from .named_maps import USUAL_NAMES, AnyMap, names, read_map
from .npz_file import read_npz
from .ros_bag import read_bag
from .series import Clock, LogReader, Series
from .smoothing import slope_of
from .spikes import leave_out_spikes
from .times import in_order
from .ulog_file import read_ulog

READERS: dict[str, LogReader] = {
    ".csv": read_csv, ".tsv": read_csv, ".txt": read_csv, ".npz": read_npz, ".ulg": read_ulog, ".ulog": read_ulog,
    ".bag": read_bag, ".mcap": read_bag, ".db3": read_bag,
}  # fmt: skip
"""Readers by file suffix; a folder is a ROS 2 bag."""
FLIGHT_READERS: dict[str, FlightReader] = {".bbl": read_blackbox, ".bfl": read_blackbox, ".bin": read_dataflash}
"""Readers of files that can contain several flights."""
MOST_BYTES = {".csv": 256 * 2**20, ".bbl": 128 * 2**20, ".bfl": 128 * 2**20, ".bin": 512 * 2**20}
"""Maximum sizes of logs that take much time or memory [bytes]."""
LARGEST = 2 * 2**30  # maximum size of other logs [bytes]
CONVERTERS = {
    ".log": "mavlogdump.py --format csv of pymavlink makes a CSV of a text log of ArduPilot",
    ".tlog": "mavlogdump.py --format csv of pymavlink makes a CSV of it",
    ".px4log": "sdlog2_dump.py of PX4 makes a CSV of a log of before 1.4",
    ".mat": "scipy.io.loadmat and numpy.savez make an NPZ of it",
    ".h5": "h5py and numpy.savez make an NPZ of it",
    ".parquet": "pandas makes a CSV of it",
}
QUANTITIES = ("position", "velocity", "attitude", "thrust", "rates", "measured_rates", "acceleration")
COMMANDS_AND_SENSORS = ("thrust", "rates", "measured_rates", "acceleration")
FLAGS = ("valid", "resets")


def read_quantities(
    path: Path, log_map: AnyMap | None, flight: int | None = None
) -> tuple[dict[str, Series], AnyMap, list[str]]:
    """Return a log's series, the map that was used to read it, and notes.

    Args:
        path: The log.
        log_map: The map; by default, the first map that fits the log.
        flight: Number of the flight in a file with several, from 1.

    The series also include ``<quantity> valid <k>``, ``<quantity> resets <k>`` and ``landed <k>``. If the log has no
    velocity, they include a derived one.

    Raises:
        LogError: The file cannot be read, or a field is missing.
    """
    raw, used_map, notes = _read(path, _reader(path, flight), log_map)
    age, clock = raw.pop("age", None), _clock(used_map)
    if age is not None and clock is not None:  # the states were measured earlier, by the logged age
        for name in ("position", "velocity", "attitude"):
            if name in raw:
                raw[name] = Series(raw[name].t - clock.scale * age.values[:, 0], raw[name].values)
    for name in ("rates", "measured_rates"):
        if name in raw and not np.any(np.nan_to_num(raw[name].values)):
            what = "not finite" if np.isnan(raw[name].values).any() else "0"
            del raw[name]
            notes.append(f"{name} are {what} throughout, and are not used")
    series = dict[str, Series]()
    for name, each in raw.items():
        if " " in name:  # a mark, which may have a single sample
            order = np.argsort(each.t, kind="stable")
            series[name] = Series(each.t[order], each.values[order])
            continue
        series[name], more = in_order(each, name, path)
        notes += more
        if name in COMMANDS_AND_SENSORS:
            series[name], more = leave_out_spikes(series[name], name, getattr(used_map, name))
            notes += more
    if isinstance(used_map, BodyMap):
        if "measured_rates" not in series:
            raise LogError(f"{path}: the gyroscope measures nothing: measured_rates are 0 or not finite throughout")
        return series, used_map, notes
    if "position" in series and "velocity" in series and not len(_valid(series, "position").t):
        del series["position"]
        used_map = replace(used_map, position=None)
        notes.append("position is never valid, and is not used")
    if "velocity" not in series:
        series["velocity"], remark = slope_of(
            path, _valid(series, "position"), METRES[getattr(used_map.position, "unit", "m")]
        )
        notes.append(remark)
        for name in ("position", "attitude"):  # the derivative does not exist at the ends
            there = np.isin(series[name].t, series["velocity"].t)
            if np.sum(there) == len(series["velocity"].t):
                series[name] = Series(series[name].t[there], series[name].values[there])
    elif "position" not in series:
        notes.append("positions are the integral of the velocities")
    return series, used_map, notes


def _read(path: Path, reader: LogReader, log_map: AnyMap | None) -> tuple[dict[str, Series], AnyMap, list[str]]:
    first: LogError | None = None
    for used_map in [log_map] if log_map is not None else map(read_map, _usual(path)):
        request, optional = _list_fields(used_map)
        try:
            own = read_decoded if isinstance(used_map, BodyMap) and used_map.decoder == "blackbox" else reader
            raw, notes = own(path, request, _clock(used_map), optional)
        except LogError as error:
            if log_map is not None or "no field" not in str(error):
                raise
            first = first or error
        else:
            return raw, used_map, notes
    usual = " or ".join(repr(name) for name in _usual(path))
    raise LogError(f"{first}; without a map it is read as {usual}: give --map map.toml") from first


def _list_fields(used_map: AnyMap) -> tuple[dict[str, tuple[str, ...]], set[str]]:
    """Return the fields of each quantity and mark, and the set of those that are optional."""
    request, optional = dict[str, tuple[str, ...]](), set[str]()
    marks = dict[str, tuple[str, ...]]()
    for name in QUANTITIES:
        spec: Any = getattr(used_map, name, None)
        if spec is None:
            continue
        request[name] = tuple(spec.fields)
        optional |= {name} if getattr(spec, "optional", False) else set()
        for flag in FLAGS:
            marks[f"{name} {flag}"] = getattr(spec, flag, ())
    marks["landed"] = () if used_map.landed is None else used_map.landed.fields
    for name, fields in marks.items():
        for k, field in enumerate(fields):
            request[f"{name} {k}"] = (field.partition("==")[0],)
            optional.add(f"{name} {k}")
    if isinstance(used_map.thrust.hover, str):
        request["hover"] = (used_map.thrust.hover,)
    if used_map.time is not None and used_map.time.age is not None:
        request["age"] = (used_map.time.age,)
    return request, optional


def _clock(used_map: AnyMap) -> Clock | None:
    return None if used_map.time is None else Clock(used_map.time.field, SECONDS[used_map.time.unit])


def _valid(series: dict[str, Series], name: str) -> Series:
    """Return a quantity's samples, except those at times that its flags mark as invalid."""
    result = series[name]
    keep = np.ones(len(result.t), dtype=bool)
    for other, flag in series.items():
        if other.startswith(f"{name} valid"):
            keep &= flag.values[np.clip(np.searchsorted(flag.t, result.t, side="right") - 1, 0, None), 0] != 0.0
    return Series(result.t[keep], result.values[keep])


def _reader(path: Path, flight: int | None) -> LogReader:
    suffix = path.suffix.lower()
    _check_file(path, suffix)
    if not path.is_dir() and suffix in FLIGHT_READERS:
        return partial(FLIGHT_READERS[suffix], flight=flight)
    if flight is not None:
        raise LogError(f"{path}: --flight {flight}: only {', '.join(FLIGHT_READERS)} files can contain several flights")
    return read_bag if path.is_dir() else READERS[suffix]


def _check_file(path: Path, suffix: str) -> None:
    """Refuse a file of an unknown kind, an empty one and one that is too large."""
    if not path.exists():
        raise LogError(f"{path}: no such file")
    if path.is_dir():
        return
    if suffix in CONVERTERS:
        raise LogError(f"{path}: {suffix} is not read; {CONVERTERS[suffix]}, to be read with --map map.toml")
    if suffix not in READERS and suffix not in FLIGHT_READERS:
        raise LogError(
            f"{path}: unknown kind of log; there are {', '.join([*READERS, *FLIGHT_READERS])}, and folders of ROS 2"
        )
    if not path.is_file():
        raise LogError(f"{path}: not a regular file")
    if (size := path.stat().st_size) == 0:
        raise LogError(f"{path}: it is empty")
    if size > (most := MOST_BYTES.get(suffix, LARGEST)):
        raise LogError(f"{path}: {size} bytes, more than the {most} that are accepted; cut out a part of the flight")


def _usual(path: Path) -> tuple[str, ...]:
    usual = USUAL_NAMES.get("" if path.is_dir() else path.suffix.lower())
    if usual is None:
        raise LogError(f"{path}: describe its fields with --map map.toml; maps by name: {', '.join(names())}")
    return usual
