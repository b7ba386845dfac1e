"""Reads PX4 logs (ULog). Needs the extra ``logs``.

A field is written ``topic.field``, for example ``vehicle_local_position.vx``. ``vehicle_attitude.q`` is a whole array,
and ``topic#1.field`` selects the second instance of a topic.
"""

import contextlib
import io
import re
from collections.abc import Collection, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import LogError
from .series import Clock, Series, find_fields, missing_field, sign_of

MICROSECOND = 1e-6


class MessageFile(io.BufferedReader):
    """A file whose position behind an incomplete message is the end that the message states.

    From a damaged message, the parser seeks back by the stated size. At the end of a file, where less than this was
    read, it would otherwise arrive before the message, and read the same bytes for ever.
    """

    def read(self, size: int | None = -1, /) -> bytes:
        """Read bytes, and move on by ``size`` even if the file has fewer."""
        data = super().read(size)
        if size is not None and len(data) < size:
            self.seek(size - len(data), io.SEEK_CUR)
        return data


def read_ulog(
    path: Path, request: Mapping[str, Sequence[str]], time: Clock | None, optional: Collection[str] = ()
) -> tuple[dict[str, Series], list[str]]:
    """Read topics from a ULog; see :class:`~retrim.io.logs.series.LogReader`.

    Times come from the map's time field if the topic contains this field. Otherwise, the topic's sample times are used
    if available, and its message times if not.
    """
    if find_spec("pyulog") is None:
        raise LogError(f"{path}: a ULog needs pyulog: pip install pyulog")
    log = _parse(path)
    topics = {f"{d.name}#{d.multi_id}" if d.multi_id else d.name: d for d in log.data_list}
    notes = ["the file is damaged; what could be read is used"] if log.file_corruption else []
    if log.dropouts:
        dropout_s = sum(each.duration for each in log.dropouts) / 1000.0
        notes.append(f"the logger dropped out {len(log.dropouts)} times, for {dropout_s:.2f} s in all")
    result = dict[str, Series]()
    for what, parts in find_fields(request, lambda each: _field(path, each, topics), optional):
        if len({id(topic) for topic, _ in parts}) > 1:
            raise LogError(f"{path}: the fields of {what} come from several topics: {', '.join(request[what])}")
        topic = parts[0][0]
        columns = [
            sign_of(name) * topic.data[key].astype(float)
            for name, (_, keys) in zip(request[what], parts, strict=True)
            for key in keys
        ]
        result[what] = Series(_times(path, topic, time), np.stack(columns, axis=1))
    return result, notes


def _times(path: Path, topic: Any, time: Clock | None) -> np.ndarray:
    """Return the times of a topic's samples [s]."""
    own = [] if time is None else [(time.field, time.scale)]
    for stamp, scale in (*own, ("timestamp_sample", MICROSECOND), ("timestamp", MICROSECOND)):
        if stamp in topic.data and np.any(topic.data[stamp]):
            return np.asarray(scale * topic.data[stamp].astype(float))
    raise LogError(f"{path}: topic {topic.name!r} has no time")


def _parse(path: Path) -> Any:
    from pyulog import ULog

    try:
        # The parser prints its findings.
        with MessageFile(io.FileIO(path)) as file, contextlib.redirect_stdout(io.StringIO()):
            log = ULog(file)
    except Exception as error:  # the parser raises various errors for bytes that are not a ULog
        raise LogError(f"{path}: cannot be read as ULog ({type(error).__name__}: {error})") from error
    if not log.data_list:
        damaged = "cannot be read as ULog: it is damaged, and has no whole sample of a topic"
        raise LogError(f"{path}: {damaged if log.file_corruption else 'this ULog holds no topic'}")
    return log


def _field(path: Path, name: str, topics: Mapping[str, Any]) -> tuple[Any, list[str]]:
    """Return a field's topic and its columns."""
    topic, _, field = name.partition(".")
    if topic not in topics:
        raise missing_field(path, topic, sorted(topics))
    data = topics[topic].data
    if field in data:
        return topics[topic], [field]
    elements = [key for key in data if re.fullmatch(re.escape(field) + r"\[\d+\]", key)]
    if not elements:
        raise missing_field(path, name, [f"{topic}.{key}" for key in data])
    return topics[topic], sorted(elements, key=lambda key: int(key[len(field) + 1 : -1]))
