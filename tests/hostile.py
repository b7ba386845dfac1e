"""Malicious files and messages: every field with code, names, signs and numbers, and valid checksums.

``cases(folder)`` yields them by kind. A case contains functions that write and read it, and states whether it may be
accepted.
"""

import dataclasses
import encodings.utf_8_sig  # noqa: F401
import io
import json
import re
import sys
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import scipy.interpolate
import scipy.optimize  # noqa: F401
from jax import random

import retrim.plants.simulations  # noqa: F401  (the registry of plants imports it at its first use)
from fake_log import MAP, columns, fly_once, write_csv
from helpers import tiny_preset
from retrim import Setup, load_learner_state, load_policy
from retrim.adapt.updates import PolicyUpdate, ResidualUpdate, Skip, pack_update, unpack_update
from retrim.config import changed, load, overlaid, read_vehicle
from retrim.config.loading import dump, values
from retrim.config.names import PLAIN_NAME
from retrim.config.references import make_reference
from retrim.evaluation.sweep import Sweep, read_sweep
from retrim.io.checkpoint import architecture, load_delta, lora_header
from retrim.io.logs import read_flight_log, read_map
from retrim.io.logs.log_map import LogMap
from retrim.live.learner_mission import LearnerMission
from retrim.live.operator.manual_disturbance import ManualDisturbance
from retrim.onboard.messages import (
    COLUMNS,
    FlightRows,
    Parameters,
    Sample,
    Setpoint,
    Stamp,
    pack_note,
    unpack_note,
)  # fmt: skip
from retrim.onboard.topics import INPUT_TOPICS, OUTPUT_TOPICS
from retrim.runkit.codecs import rows_codec
from retrim.transport import wire
from retrim.transport.message import pack_arrays

MEGABYTE = 2**20
TEXTS = {
    "code": "__import__('os').system('touch OWNED')",
    "python name": "os:abort",
    "server": "http.server:test",
    "own module": "mine_of_a_stranger:run",
    "own module in a sum": "circle+mine_of_a_stranger:run",
    "own module of a size": "wind+mine_of_a_stranger:run=3",
    "own module as a file": "x.csv:mine_of_a_stranger:run",
    "comment of C": "*/ int system(const char *); /*",
    "formula": "cost $x_$",
    "page": "[a](javascript:alert(1))<script>|",
    "terminal": "a\x1b]0;owned\x07\x1b[2J",
    "lines": "a\nb\r\nc",
    "nothing between": "a\x00b",
    "right to left": "a\u202eb",
    "up": "../../../../tmp/owned.csv",
    "up to a vehicle": "../../../../tmp/owned.toml",
    "address": "file:///etc/passwd",
    "format": "%s%n{0.__class__}",
    "empty": "",
    "long": MEGABYTE * "x",
    "long name": f"mine_of_a_stranger:{MEGABYTE * 'x'}",
}
NUMBERS = {  # JSON and TOML
    "nan": ("NaN", "nan"),
    "inf": ("Infinity", "inf"),
    "-inf": ("-Infinity", "-inf"),
    "3e38": ("3e38", "3e38"),
    "1e400": ("1e400", "1e400"),
    "googol": ("1" + 100 * "0",) * 2,
    "digits": (5000 * "9",) * 2,
    "10^400": ("1" + 400 * "0",) * 2,
    "2^63": (str(2**63),) * 2,
    "true": ("true", "true"),
    "text": ('"1"', '"1"'),
    "list": ('["a", {}]', '["a", {}]'),
    "deep list": (5000 * "[" + 5000 * "]",) * 2,
    "deep table": (5000 * '{"a":' + "1" + 5000 * "}", 5000 * "{a=" + "1" + 5000 * "}"),
    "many": ("[" + ",".join(100_000 * "1") + "]",) * 2,
    # These values may be valid for a field; they are accepted, or refused with one line.
    "-0": ("-0.0", "-0.0"),
    "-1": ("-1", "-1"),
    "null": ("null", None),
    "no list": ("[]", "[]"),
    "no table": ("{}", "{}"),
}
MAY_BE_FINE = ("-0", "-1", "null", "no list", "no table")
MARK = "@HOSTILE@"
PYTHON = re.compile("python name|server|own module")


@dataclass(frozen=True)
class Case:
    """One file or message."""

    name: str
    read: Callable[[], object]
    may_be_read: bool = False
    """Whether the case may be valid, so that reading succeeds."""


def texts_and_numbers(*, toml: bool) -> Iterator[tuple[str, str]]:
    """Return names and texts of malicious values in one of the two notations."""
    for name, text in TEXTS.items():
        yield name, json.dumps(text, ensure_ascii=True)
    for name, pair in NUMBERS.items():
        if pair[toml] is not None:
            yield name, pair[toml]


def toml_of(tables: dict) -> str:
    """Return TOML of plain tables; nested tables are inline."""
    return "".join(f"{key} = {_inline(value)}\n" for key, value in tables.items())


def _inline(value) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_inline(each)}" for key, each in value.items() if each is not None) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_inline, value)) + "]"
    return json.dumps(value)


def places(tables: dict, before=()) -> Iterator[tuple[tuple, object]]:
    """Return paths and values of all leaves, tables, and members of lists."""
    for key, value in tables.items():
        yield (*before, key), value
        if isinstance(value, dict):
            yield from places(value, (*before, key))
        elif isinstance(value, list | tuple):
            yield from places(dict(enumerate(value)), (*before, key))


def with_mark(tables: dict, path: tuple) -> dict:
    """Return the same tables with the mark at a path."""

    def put(value, rest):
        if not rest:
            return MARK
        if isinstance(value, list | tuple):
            return [put(each, rest[1:]) if i == rest[0] else each for i, each in enumerate(value)]
        return {**value, rest[0]: put(value[rest[0]], rest[1:])}

    return put(tables, path)


def without_none(tables: dict) -> dict:
    """Return the tables without null values, which TOML does not have."""
    return {k: without_none(v) if isinstance(v, dict) else v for k, v in tables.items() if v is not None}


def variants(tables: dict, *, toml: bool, free=()) -> Iterator[tuple[str, Callable[[], str], bool]]:
    """Yield name, writer and validity: each path with each value, and unknown keys."""
    paths = toml_of if toml else json.dumps
    for path, value in places(tables):
        whole = paths(with_mark(tables, path))
        for name, text in texts_and_numbers(toml=toml):
            plain = isinstance(value, str) and name in TEXTS and (path[-1] in free or _plain(path, name))
            plain = plain or (path[-1] == "name" and name == "text")
            fine = plain or name in MAY_BE_FINE or (name == "2^63" and isinstance(value, float))
            yield f"{'.'.join(map(str, path))}: {name}", partial(whole.replace, json.dumps(MARK), text), fine
    for name, text in TEXTS.items():
        key = json.dumps(text)
        whole = paths({"zzz": 1, **tables})
        marks, put = ("zzz =", f"{key} =") if toml else ('"zzz"', key)
        yield f"key {name}", partial(whole.replace, marks, put, 1), False
    many = "\n".join(f"k{i} = 1" for i in range(60_000)) if toml else ",".join(f'"k{i}":1' for i in range(90_000))
    whole = paths({"zzz": 1, **tables})
    yield "many keys", partial(whole.replace, "zzz = 1" if toml else '"zzz": 1', many, 1), False


def _plain(path, name) -> bool:
    return path[-1] == "name" and PLAIN_NAME.fullmatch(TEXTS[name]) is not None


def write(about: dict) -> dict[str, str]:
    """Return a header with evaluated texts."""
    return {name: text if isinstance(text, str) else text() for name, text in about.items()}


class CaseMaker:
    """Creates cases in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.n, self.paths = folder, 0, list[Path]()
        self.preset = changed(tiny_preset(), pretrain={"hidden_sizes": (12, 12)}, adapt={"residual": "linear"})
        self.setup = Setup.from_preset(self.preset)
        with jax.numpy_dtype_promotion("standard"):
            self.policy = self.setup.new_policy(random.key(0))
            self.state = self.setup.learner.init(self.policy, random.key(1))
            self.lora = self.setup.learner.init(self.setup.low_rank(self.policy, random.key(2)), random.key(3))

    def file(self, data: bytes | str, suffix: str) -> Path:
        """Write a file."""
        self.n += 1
        path = self.folder / f"{self.n}{suffix}"
        self.paths.append(path)
        path.write_bytes(data.encode("utf-8", "surrogatepass") if isinstance(data, str) else data)
        return path

    def clear(self) -> None:
        """Remove the written files."""
        for path in self.paths:
            path.unlink(missing_ok=True)
        self.paths.clear()

    def cases(self) -> Iterator[Case]:
        """Return cases of all kinds."""
        files = self.policies, self.states, self.deltas, self.overlays, self.vehicles, self.sweeps, self.maps
        logs = self.csv_logs, self.npz_logs, self.trajectories
        for kind in (*files, *logs, self.missions, self.messages, self.rows):
            for case in kind():
                yield dataclasses.replace(case, name=f"{kind.__name__}: {case.name}")

    def presets(self) -> Iterator[tuple[str, Callable[[], str], bool]]:
        """Return JSON of presets."""
        tracking = changed(load("track/retrim"), pretrain={"hidden_sizes": (8, 8)})
        for preset in (self.preset, tracking):
            for name, text, fine in variants(json.loads(dump(preset)), toml=False, free=("options",)):
                yield f"{preset.task} {name}", text, fine

    def policies(self) -> Iterator[Case]:
        """Return policies with a malicious header or malicious tensors."""

        def case(name, policy, about, fine=False):
            def read():
                return load_policy(self.file(wire.pack(policy, kind="policy", about=write(about)), ".safetensors"))

            return Case(name, read, fine)

        sizes = {"architecture": architecture(self.policy)}
        for name, text, fine in self.presets():
            yield case(name, self.policy, {"preset": text, **sizes}, fine)
        for name, text in TEXTS.items():
            yield case(f"architecture {name}", self.policy, {"preset": dump(self.preset), "architecture": text})
        for text in (9000 * "9", "1-" * 9000 + "4", "-1-8-4", "0-8-8-4", "16384-16384-16384-4", "1e3-8-8-4"):
            yield case(f"architecture {text[:9]}", self.policy, {"preset": dump(self.preset), "architecture": text})
        for value in (3e38, -3e38, np.inf, np.nan, 1e6):
            for path, _ in jax.tree_util.tree_leaves_with_path(self.policy):
                where = jax.tree_util.keystr(path)

                def changed_leaf(at, old, where=where, value=value):
                    return jnp.full_like(old, value) if jax.tree_util.keystr(at) == where else old

                wrong = jax.tree_util.tree_map_with_path(changed_leaf, self.policy)
                yield case(f"{where} {value}", wrong, {"preset": dump(self.preset), **sizes})
        header = {"preset": dump(self.preset), **sizes}
        arrays = wire.names(self.policy)
        for name, text in TEXTS.items():
            for kind, more in (("policy", {text: np.zeros(1)}), (text[:1000], {})):

                def read(kind=kind, more=more):
                    data = pack_arrays({**arrays, **more}, kind=kind, about=header)
                    return load_policy(self.file(data, ".safetensors"))

                yield Case(f"tensor or kind {name}", read)

    def states(self) -> Iterator[Case]:
        """Return learner states."""

        def case(name, state, about, fine=False):
            def read():
                return load_learner_state(
                    self.file(wire.pack(state, kind="learnt", about=write(about)), ".safetensors")
                )

            return Case(name, read, fine)

        sizes = {"architecture": architecture(self.policy)}
        for name, text, fine in self.presets():
            yield case(name, self.state, {"preset": text, **sizes}, fine)
        about = {"preset": dump(self.preset), **sizes, **lora_header(self.lora.policy.policy)}
        for field in ("ranks", "scale", "architecture"):
            for name, text in (*TEXTS.items(), *((name, pair[0]) for name, pair in NUMBERS.items())):
                fine = field == "scale" and name in (
                    "-0",
                    "-1",
                    "3e38",
                    "2^63",
                    "googol",
                    "10^400",
                )  # the header of the tensor states it
                yield case(f"{field} {name}", self.lora, {**about, field: text}, fine)

    def deltas(self) -> Iterator[Case]:
        """Return low-rank deltas."""
        from retrim.io.checkpoint import fingerprint

        lora = self.lora.policy.policy
        about = {"base": fingerprint(lora.base), **lora_header(lora)}
        for field in about:
            for name, text in (*TEXTS.items(), *((name, pair[0]) for name, pair in NUMBERS.items())):
                fine = field == "scale" and name in ("-0", "-1", "3e38", "2^63", "googol", "10^400")  # times zeros

                def read(field=field, text=text):
                    data = wire.pack((lora.delta, lora.shift), kind="delta", about={**about, field: text})
                    return load_delta(self.file(data, ".safetensors"), lora.base)

                yield Case(f"{field} {name}", read, fine)

    def overlays(self) -> Iterator[Case]:
        """Return overlays of presets."""
        for below in (self.preset, load("track/retrim")):
            tables = without_none(values(below))
            tables.pop("options")
            for name, text, fine in variants(tables, toml=True):

                def read(text=text, below=below):
                    return Setup.from_preset(overlaid(below, self.file(text(), ".toml")))

                yield Case(f"{below.task} {name}", read, fine)

    def vehicles(self) -> Iterator[Case]:
        """Return vehicle files, alone and in a preset."""
        tables = {
            "name": "quad", "mass": 0.7, "inertia": [2e-3, 2e-3, 3e-3], "arm": [0.08, 0.08], "thrust_max": 30.0,
            "rates_max": [9.0, 9.0, 4.0], "motor_tau": 0.03, "rate_lag": [0.03, 0.03, 0.1], "command_delay": 0.02,
            "propeller": "5 inch", "propeller_diameter": 5.1, "drag_area": [0.01, 0.01, 0.02],
        }  # fmt: skip
        for name, text, fine in variants(tables, toml=True):
            is_unbounded = fine or re.search("3e38|2.63|googol|10.400", name) is not None
            yield Case(name, lambda text=text: read_vehicle(self.file(text(), ".toml")).build(), is_unbounded)

    def sweeps(self) -> Iterator[Case]:
        """Return sweep files. A sweep with names that are resolved later is converted to scenarios."""
        tables = {
            "presets": ["hover/fast"], "seeds": [0], "methods": ["base"], "disturbances": ["none"], "plants": ["bem"],
            "vehicles": ["small"], "sensors": ["ideal"], "references": ["circle"], "starts": 1, "seconds": 5.0,
            "overlay": {"dt": 0.01, "adapt": {"residual": "linear"}},
        }  # fmt: skip

        def read(text):
            sweep: Sweep = read_sweep(self.file(text(), ".toml"))
            from retrim.config.limits import check_seeds
            from retrim.config.methods import find_method

            check_seeds(sweep.seeds)
            sweep.scenarios()
            [make_reference(name) for name in sweep.references]
            [find_method(name) for name in sweep.methods]
            return [Setup.from_preset(changed(load(name), **sweep.overlay)) for name in sweep.presets]

        for name, text, fine in variants(tables, toml=True):
            yield Case(name, lambda text=text: read(text), fine or name.startswith(("references", "seconds: 2")))

    def maps(self) -> Iterator[Case]:
        """Return log maps."""
        tables = {
            "time": {"field": "t", "unit": "s", "age": "age"}, "position": {"fields": ["px", "py", "pz"], "unit": "m"},
            "velocity": {"fields": ["vx", "vy", "vz"]}, "attitude": {"fields": ["q"], "form": "xyzw"},
            "thrust": {"fields": ["c"], "unit": "share", "hover": 0.4}, "rates": {"fields": ["w"]},
            "acceleration": {"fields": ["a"], "axes": "body", "gravity": "included"},
            "frames": {"world": "ENU", "body": "FLU"}, "part": {"start": 0.0, "end": 5.0},
        }  # fmt: skip
        assert {each.name for each in dataclasses.fields(LogMap)} >= tables.keys()
        for name, text, fine in variants(tables, toml=True):
            names = "fields" in name or "field:" in name or "hover" in name or "age:" in name or "part" in name
            yield Case(name, lambda text=text: read_map(self.file(text(), ".toml")), fine or names)

    def csv_logs(self) -> Iterator[Case]:
        """Return CSV logs with malicious cells, headers and times."""
        table, path = columns(fly_once(1.0)), self.folder / "plain.csv"
        lines = write_csv(path, table).read_text().splitlines()
        log_map = read_map(self.file(MAP, ".toml"))
        cells = [*TEXTS.values(), *(pair[0] for pair in NUMBERS.values()), "1e308", "-1e308", "1e18", "\ud800", "0x10"]
        width = len(lines[0].split(","))
        for place in range(width):
            for cell in cells:
                for row in (0, 20):
                    changed_row = lines[row].split(",")
                    changed_row[place] = cell
                    text = "\n".join([*lines[:row], ",".join(changed_row), *lines[row + 1 :]])
                    yield Case(f"cell {place} {cell[:20]!r} in {row}",
                               lambda text=text: read_flight_log(self.file(text, ".csv"), log_map), True)  # fmt: skip

    def npz_logs(self) -> Iterator[Case]:
        """Return NPZ logs with arrays of any type and shape, and any names of members."""
        n = 60
        fine = {
            "t": 0.02 * np.arange(n), "age": np.zeros(n),
            "p_measured": np.zeros((n, 3)), "v_measured": np.zeros((n, 3)),
            "R_measured": np.tile(np.eye(3), (n, 1, 1)), "u": np.tile([9.8, 0, 0, 0], (n, 1)),
        }  # fmt: skip
        wrong = {
            "objects": np.array([{}] * n, dtype=object), "texts": np.array(["os:abort"] * n),
            "complex": np.full(n, 1j), "bools": np.ones(n, bool), "nothing": np.zeros(0), "one": np.array(1.0),
            "nan": np.full((n, 3), np.nan), "inf": np.full((n, 4), np.inf), "3e38": np.full((n, 9), 3e38),
            "1e308": np.full(n, 1e308), "times": np.zeros(n, "datetime64[s]"), "table": np.zeros(n, "f8,i4"),
            "many axes": np.zeros((n,) + (1,) * 20), "huge ints": np.full(n, 2**63, np.uint64),
        }  # fmt: skip
        for field in fine:
            for name, array in wrong.items():
                data = io.BytesIO()
                np.savez(data, **{**fine, field: array})
                yield Case(
                    f"{field} {name}", lambda data=data: read_flight_log(self.file(data.getvalue(), ".npz")), True
                )
        for name, text in TEXTS.items():
            data = io.BytesIO()
            np.savez(data, **fine)
            with zipfile.ZipFile(data, "a") as archive:
                archive.writestr(text[:60_000] or "x", b"import os; os.abort()")
            yield Case(f"member {name}", lambda data=data: read_flight_log(self.file(data.getvalue(), ".npz")), True)

    def trajectories(self) -> Iterator[Case]:
        """Return trajectory files with malicious cells and headers."""
        lines = ["t,x,y,z,yaw", *(f"{0.5 * i},{i % 3},{i % 2},1.0,0.0" for i in range(9))]
        cells = [*TEXTS.values(), *(pair[0] for pair in NUMBERS.values()), "1e308", "-1e308", "1e18", "0x10", "1_0"]
        for row in (0, 4):
            for place in range(5):
                for cell in cells:
                    changed_row = lines[row].split(",")
                    changed_row[place] = cell
                    text = "\n".join([*lines[:row], ",".join(changed_row), *lines[row + 1 :]])
                    yield Case(f"cell {place} {cell[:20]!r} in {row}",
                               lambda text=text: make_reference(str(self.file(text, ".csv"))), True)  # fmt: skip

    def missions(self) -> Iterator[Case]:
        """Return missions of remote learners."""
        preset = dump(self.preset)
        start = wire.pack(
            self.state, kind="learnt", about={"preset": preset, "architecture": architecture(self.policy)}
        )
        fields = {
            "number": 1, "reference": "circle", "seed": 0, "base": "abc", "layers": ["policy"], "floor": 0,
            "capacities": dict.fromkeys((*OUTPUT_TOPICS[:2], INPUT_TOPICS[0]), 1000),
        }  # fmt: skip

        def case(name, text, start=start, fine=False):
            def read():
                file = start if isinstance(start, bytes) else start()
                about = write({"fields": text, "bytes": str(len(file))})
                data = pack_arrays({"start": np.frombuffer(file, np.uint8)}, kind="mission", about=about)
                mission = LearnerMission.unpack(data)
                mission.check(())
                return mission

            return Case(name, read, fine)

        for name, text, _ in variants(fields, toml=False):
            yield case(name, text, fine=not (name.startswith("reference") and PYTHON.search(name)))
        for name, text, _ in self.presets():  # invalid names are refused by the builder

            def make_learner_state(text=text):
                return wire.pack(self.state, kind="learnt", about={"preset": text()})

            yield case(name, json.dumps(fields), make_learner_state, not PYTHON.search(name))
        yield case("no file", json.dumps(fields), b"")

    def messages(self) -> Iterator[Case]:
        """Return small messages: notes, knobs, parameters, updates."""
        knobs = dict(vars(ManualDisturbance()))
        for name, text, fine in variants(json.loads(json.dumps(knobs)), toml=False):
            may = fine or "key" in name or any(word in name for word in ("true", "text", "kicks"))

            def read(text=text):
                return ManualDisturbance.unpack(pack_arrays({}, kind="knobs", about={"fields": text()}))

            yield Case(f"knobs {name}", read, may)
        many = "{" + ",".join(f'"k{i}":1' for i in range(9999)) + "}"
        for name, text in (*texts_and_numbers(toml=False), ("many keys", many)):
            data = pack_arrays({}, kind="order", about={"fields": text})
            may = name in ("no table", "many keys", "deep table")
            yield Case(f"note {name}", lambda data=data: unpack_note(data, "order"), may)
            yield Case(f"kind {name}", lambda text=text: unpack_note(pack_note(text[:70_000]), "order"))
        expected = {"a": np.zeros(3)}
        for field in ("version", "base", "computed_from", "parent"):
            for name, text in (*TEXTS.items(), *((name, pair[0]) for name, pair in NUMBERS.items())):
                about = {"version": "2", "base": "b", "computed_from": "1.0", "parent": "1"} | {field: text}
                data = pack_arrays(expected, kind="parameters of policy", about=about)
                yield Case(
                    f"parameters {field} {name}",
                    lambda data=data: Parameters.unpack(data, expected, half="policy", base="b", after=0),
                    field != "base" and name in (*MAY_BE_FINE, "3e38", "2^63", "googol", "10^400", "digits"),
                )
        plain = PolicyUpdate(1.0, 0.5, 0.4, self.state.policy)
        fit_result, skip = ResidualUpdate(1.0, 0.1, self.state.residual), Skip(1.0, "policy")
        for update, kind in ((plain, "policy"), (fit_result, "residual"), (skip, "skipped")):
            data = pack_update(update)
            message = wire.kind_of(data, source="x")
            header = wire.describe(data, kind=message, source="x")
            for name, text, fine in variants(json.loads(header["update"]), toml=False):
                may = fine or any(word in name for word in ("3e38", "2^63", "googol", "10^400", "inf", "nan", "1e400"))

                def read(text=text, update=update, kind=message):
                    forgery = wire.pack(getattr(update, "state", ()), kind=kind, about={"update": text()})
                    return unpack_update(forgery, self.state, source="x")

                yield Case(f"{kind} {name}", read, may)

    def rows(self) -> Iterator[Case]:
        """Return rows of a flight, samples, commands, and rows of a sweep."""
        for value in (np.nan, np.inf, 3e38, -3e38, 1e308, -0.0, 2.0**63):
            for i in range(len(COLUMNS)):
                row = np.zeros((2, len(COLUMNS)))
                row[0, i] = value
                data = FlightRows(row).pack()
                yield Case(f"rows {i} {value}", lambda data=data: FlightRows.unpack(data), bool(np.isfinite(value)))
            for i in range(38):
                numbers = np.zeros(38)
                numbers[i] = value
                data = pack_arrays({"row": numbers.view(np.int64)}, kind="sample", about={})
                for read in (Sample.unpack, Stamp.unpack):
                    yield Case(f"{read.__qualname__} {i} {value}", lambda data=data, read=read: read(data), True)
            for i in range(10):
                numbers = np.zeros(10)
                numbers[i] = value
                data = pack_arrays({"row": numbers}, kind="setpoint", about={})
                yield Case(f"setpoint {i} {value}", lambda data=data: Setpoint.unpack(data), bool(np.isfinite(value)))
        for name, text in texts_and_numbers(toml=False):
            for line in (text, f'{{"key": {text}}}', f'{{"key": "a", "failed": {text}}}', f"{{{text}: 1}}"):
                yield Case(f"row {name}", lambda line=line: rows_codec().read(self.file(line, ".jsonl")), True)
        yield Case("row of bytes", lambda: rows_codec().read(self.file(b"\xff\xfe{}\n", ".jsonl")), True)


def callers() -> Iterator[str]:
    """Return the files of the functions on the stack."""
    frame = sys._getframe()
    while frame is not None:
        yield frame.f_code.co_filename
        frame = frame.f_back


class AuditHook:
    """An audit hook that records events during reading: imports, code, processes, written files, sockets."""

    EVENTS = (
        "import", "exec", "compile", "pickle.find_class", "subprocess.Popen", "socket.bind", "socket.connect",
        "ctypes.dlopen", "webbrowser.open", "marshal.loads", "code.__new__",
    )  # fmt: skip

    RUNS = ("os.system", "os.exec", "os.spawn", "os.posix_spawn", "os.fork", "shutil.")
    CHANGES = ("os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.chmod", "os.link", "os.symlink")

    def __init__(self, folder: Path) -> None:
        own = (folder, jax.config.jax_compilation_cache_dir or folder)  # of the test, and of JAX
        self.folders, self.on, self.events = tuple(map(str, own)), False, list[str]()
        sys.addaudithook(self)

    def __call__(self, event: str, args: tuple) -> None:
        """Record an event; Python always calls this method, which takes little time while it is off."""
        if not self.on:
            return
        paths = event == "open" and isinstance(args[1], str) and set(args[1]) & set("wax+")
        inside = bool(args) and str(args[0]).startswith(self.folders)
        if event == "compile" and args[1] == "<unknown>":
            return  # ast.literal_eval executes no code; NumPy reads the headers of arrays with it
        if event in ("compile", "exec") and any("/jaxtyping/" in name for name in callers()):
            return  # the tests check shapes
        if event in self.EVENTS or event.startswith(self.RUNS) or ((paths or event in self.CHANGES) and not inside):
            self.events.append(f"{event} {str(args)[:200]}")
