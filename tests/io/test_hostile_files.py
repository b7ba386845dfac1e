"""Malicious files and messages with valid checksums: none of their content is executed, and each gives one line of an
error.

Every run reads a part of them; ``pytest -n 0 -m slow tests/io/test_hostile_files.py`` reads all.
"""

import io
import json
import os
import sys
import tracemalloc
import zipfile
from collections import Counter

import numpy as np
import pytest

from fake_flights import flight
from hostile import TEXTS, AuditHook, CaseMaker
from retrim import load_learner_state, load_policy
from retrim.config import read_vehicle
from retrim.errors import CheckpointError, ConfigError, LogError, RetrimError
from retrim.evaluation import sweep
from retrim.evaluation.metrics import FIGURES, record
from retrim.io.logs import npz_members, read_flight_log, read_map
from retrim.io.logs.npz_members import NpzMembers
from retrim.live.operator.page import free_port
from retrim.runkit import Run
from retrim.runkit.reporter import Silent
from retrim.tasks.trajectory_csv import from_csv

LONGEST = 500
FEW = 101
"""Every run reads one of this number of cases."""


@pytest.fixture(scope="module")
def watch(tmp_path_factory):
    return AuditHook(tmp_path_factory.getbasetemp())


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return the current folder, which contains a foreign module."""
    for name in ("mine_of_a_stranger", "calendar", "numpy", "x"):
        (tmp_path / f"{name}.py").write_text("open('OWNED', 'w')\ndef run(*_): pass\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    return tmp_path


def outcome(case, watch):
    """Return the outcome of a case: ``refused``, ``read``, or a description of a fault."""
    watch.events.clear()
    watch.on = True
    try:
        case.read()
        result = "read" if case.may_be_read else f"{case.name}: it was read"
    except RetrimError as error:
        line = str(error)
        fine = line and line.isprintable() and len(line) < LONGEST
        result = "refused" if fine else f"{case.name}: a message of {len(line)} characters: {line[:100]!r}"
    except BaseException as error:
        result = f"{case.name}: {type(error).__name__}: {str(error)[:200]}"
    finally:
        watch.on = False
    return f"{case.name}: {watch.events[:3]}" if watch.events else result


def read_all(folder, watch, every):
    """Read each ``every``-th case twice, since the first read imports modules for reasons other than the case."""
    maker, result = CaseMaker(folder), list[str]()

    def choose(each):
        return (case for i, case in enumerate(maker.cases()) if i % each == 0)

    for case in choose(50 * every):
        outcome(case, watch)
        maker.clear()
    modules = set(sys.modules)
    for case in choose(every):
        result.append(outcome(case, watch))
        maker.clear()
    faults = [each for each in result if each not in ("refused", "read")]
    assert not faults, f"{len(faults)} of {len(result)}:\n" + "\n".join(faults[:100])
    assert not {name for name in set(sys.modules) - modules if "stranger" in name}
    assert not list(folder.glob("**/OWNED"))
    return Counter(result)


def test_some_hostile_files_run_nothing_and_give_one_line(folder, watch):
    result = read_all(folder, watch, FEW)
    assert result["refused"] > result["read"]


@pytest.mark.slow
def test_all_hostile_files_run_nothing_and_give_one_line(folder, watch):
    result = read_all(folder, watch, 1)
    assert result["refused"] >= 10_000


# ---- large files, and files that unpack to a large size


def archive_of(path, **arrays):
    np.savez_compressed(path, **arrays)
    return path


def test_array_outside_map_is_not_unpacked(folder):
    n, zeros = 100, np.zeros((100, 3))
    fine = {"t": 0.02 * np.arange(n), "p": zeros, "v": zeros, "R": np.tile(np.eye(3), (n, 1, 1)), "c": zeros[:, :1]}
    path = archive_of(folder / "log.npz", **fine, unused=np.zeros(2**23))
    assert path.stat().st_size < 2**20
    members = NpzMembers(path)
    tracemalloc.start()
    assert {name: members[name].shape for name in fine} == {name: each.shape for name, each in fine.items()}
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_size_is_checked_before_reading(folder, monkeypatch):
    path = archive_of(folder / "log.npz", t=np.zeros(10_000))
    monkeypatch.setattr(npz_members, "MAX_MEMBER", 1000)
    with pytest.raises(LogError, match="array 't' has 80128 bytes, more than the 1000 that are accepted"):
        NpzMembers(path)["t"]
    logs = dict.fromkeys(("l.csv", "l.ulg", "l.npz"), read_flight_log)
    others = {
        "t.csv": from_csv,
        "v.toml": read_vehicle,
        "p.safetensors": load_policy,
        "s.safetensors": load_learner_state,
    }
    for name, read in (logs | others).items():
        with (folder / name).open("wb") as file:
            file.truncate(3 * 2**30)  # a sparse file takes no space
        with pytest.raises(RetrimError, match="accepted"):
            read(folder / name)
        (folder / name).unlink()
        os.mkfifo(folder / name)
        with pytest.raises(RetrimError, match=r"no such file|not a regular file"):
            read(folder / name)


def test_excessive_size_in_header_takes_no_memory(folder):
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(folder / "log.npz", "w") as archive:
        archive.writestr("t.npy", head.getvalue())
    with pytest.raises(LogError, match=r"not a whole NPZ file \(an array of \(1000000000000,\)"):
        NpzMembers(folder / "log.npz")["t"]
    for size, why in ((2**40, "not a whole safetensors file"), (5 * 2**20, "a header of 5242880 bytes, more than")):
        (folder / "p.safetensors").write_bytes(size.to_bytes(8, "little") + b"{" + 5 * 2**20 * b" ")
        with pytest.raises(CheckpointError, match=why):
            load_policy(folder / "p.safetensors")


def test_invalid_rows_of_sweep_are_repeated(folder):
    """A row needs all entries of a record, with finite figures, and the conditions that belong to its key."""
    row, key = {"key": 15 * "0" + "a", "preset": "p", **record(flight(0.1))}, 15 * "0" + "b"
    expected = {key: {"preset": "p", "method": "full", "seed": 3}}
    good = [row, {**row, "key": key, "method": "full", "seed": 3, "behind_s": -0.5}]
    good.append({**row, "key": 15 * "0" + "c", "crashed": True, "error": None})
    changes = [
        *({"key": value} for value in (4, "good", "../../../../x", 5000 * "a")),
        *({name: 3} for name in ("preset", "plant", "reference", "failed", "fault", "metric")),
        *({name: value} for name in ("seed", "start") for value in ([1], -1, 1.0, True, None)),
        *({"crashed": value} for value in ("x", 0, None, True)),
        *({name: value} for name in FIGURES for value in ("x", [0.1], True, -5, 1e308, float("nan"), 10**400)
          if (name, value) != ("behind_s", -5)),
        {"error": None}, {"delay": None}, {"thrust_error": float("inf")},
        {"key": key}, {"key": key, "method": "full"}, {"key": key, "seed": 3}, {"key": key, "plant": "bem"},
    ]  # fmt: skip
    wrong = [*({**row, **change} for change in changes), {"key": row["key"]}, [], 1]
    wrong += [{name: value for name, value in row.items() if name != missing} for missing in row]
    lines = [json.dumps(each).encode() for each in (*wrong, *good)]
    (folder / "flights.jsonl").write_bytes(b"\n".join([b"\xff\xfe", *lines, b'{"key": "torn']))
    text, reporter = [], Silent()
    reporter.say = text.append
    assert list(sweep._FlightRows(Run("test", folder), reporter, expected).by_key.values()) == good
    count = len(wrong) + 2  # bytes that are no text, and a torn line
    assert text == [f"{folder / 'flights.jsonl'}: unusable lines, {count}; their flights are flown again"]


def test_invalid_host_gives_one_line():
    for host in ("a\x1b[2J", "a\x00b", 300 * "a" + ".b", 400 * "x", "\ud800", ".", "..", "é" * 100):
        with pytest.raises(ConfigError, match="neither an address nor the name of a host") as error:
            free_port(host, 8080)
        assert str(error.value).isprintable()
        assert len(str(error.value)) < LONGEST


# ---- formats whose reader generates code from message definitions in the file


@pytest.mark.parametrize("encoding", ["ros2msg", "ros2idl"])
def test_message_types_in_bag_are_not_executed(folder, encoding):
    writer, _ = pytest.importorskip("mcap.writer"), pytest.importorskip("rosbags")
    run = "open('OWNED', 'w')"
    names = [
        f"a/msg/B:\n    pass\n{run}\nclass C",
        f'a/msg/B"""\n{run}\n"""',
        f"{run}/msg/B",
        "a/msg/B",
        *TEXTS.values(),
    ]
    texts = ["float64 x", f"float64 x\n{run}", f"float64 x = {run}", f"string X={run}\nfloat64 x", f"float64[{run}] x"]
    for name, text in [*((name, texts[0]) for name in names), *(("a/msg/B", text) for text in texts)]:
        with (folder / "log.mcap").open("wb") as file:
            bag = writer.Writer(file)
            bag.start(profile="ros2", library="")
            idl = f"module a {{ module msg {{ struct B {{ double x; }}; const string Y = {text!r}; }}; }};"
            data = (text if encoding == "ros2msg" else idl).encode("utf-8", "replace")
            schema = bag.register_schema(name=name[:1000], encoding=encoding, data=data)
            channel = bag.register_channel(topic="/t", message_encoding="cdr", schema_id=schema)
            bag.add_message(channel, log_time=0, data=b"\0\1\0\0" + bytes(8), publish_time=0)
            bag.finish()
        with pytest.raises(LogError) as error:
            read_flight_log(folder / "log.mcap")
        assert str(error.value).isprintable()
        assert len(str(error.value)) < LONGEST
        assert not (folder / "OWNED").exists(), name


def test_boolean_is_not_a_number_in_map(folder):
    for table in ("[part]\nstart = true", "[part]\nend = true", "thrust.mass = true"):
        (folder / "map.toml").write_text(table)
        with pytest.raises(ConfigError, match=r"(part|thrust).(start|end|mass): Input should be a valid number"):
            read_map(folder / "map.toml")
