"""A store computes a value once per key; a damaged or foreign file is refused, and the value is computed again."""

import json
import pickle
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fake_flights import flight
from helpers import tiny_preset
from retrim import Scenario, Setup
from retrim.runkit import FlightSpec
from retrim.runkit.codecs import json_codec, policy_codec, rows_codec, section_codec, tree_codec
from retrim.runkit.document import TableSection
from retrim.runkit.flight_codec import flight_codec
from retrim.runkit.reporter import Silent
from retrim.runkit.store import Store

SPECS, OTHER_SPECS = (
    [FlightSpec(Scenario(plant="simple"), method, start) for start in range(2)] for method in ("base", "indi")
)
TREE = {"weights": jnp.arange(6.0).reshape(2, 3), "key": jax.random.key(3), "name": "kept out of the file"}
OTHERS = {
    "json": json_codec("other"),
    "tree": tree_codec(TREE, "other"),
    "policy": policy_codec(tiny_preset(goal=(0.0, 0.0, 2.0))),
    "flights": flight_codec(OTHER_SPECS),
    "section": json_codec("other"),
}


def leaves(value):
    """Return the contents of a value, with arrays and keys as bytes."""
    if isinstance(value, TableSection):
        return value
    if isinstance(value, tuple | list) and any(isinstance(each, TableSection) for each in value):
        return [*value]
    if isinstance(value, list) and hasattr(value[0], "log"):
        value = [(f.spec, f.vehicle, f.metric, f.log, f.error) for f in value]
    result = []
    for leaf in jax.tree.leaves(value):
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        result.append(np.asarray(leaf).tobytes() if isinstance(leaf, np.ndarray | jax.Array) else leaf)
    return result


@pytest.fixture
def case(request, tmp_path):
    """Return a codec and a value of each kind."""
    picture = tmp_path / "x.png"
    picture.write_bytes(b"drawn")
    preset = tiny_preset()
    policy = Setup.from_preset(preset).new_policy(jax.random.key(0))
    section = TableSection(("a", "b"), (("1", "2"),), "Title", "About.", picture)
    return {
        "json": lambda: (json_codec("note"), {"s": 0.1, "names": ["a", None], "infinite": float("inf")}),
        "tree": lambda: (tree_codec(TREE, "tree", {"made": "of"}), TREE),
        "policy": lambda: (policy_codec(preset), policy),
        "flights": lambda: (flight_codec(SPECS), [flight(0.1 * (1 + spec.start), spec=spec) for spec in SPECS]),
        "section": lambda: (section_codec(tmp_path), (section, [{"error": 1 / 3}])),
    }[request.param]()


def store_in(folder, stop=None):
    text, reporter = [], Silent()
    reporter.say = text.append
    return Store(folder, reporter=reporter, stop=stop), text


every_kind = pytest.mark.parametrize("case", list(OTHERS), indirect=True)


@every_kind
def test_value_is_computed_once_and_restored_exactly(case, tmp_path):
    codec, value = case
    store, text = store_in(tmp_path / "store")
    first = store.get_or_make("folder/key", lambda: value, codec)
    again = store_in(tmp_path / "store")[0].get_or_make("folder/key", lambda: pytest.fail("made again"), codec)
    assert leaves(first) == leaves(again) == leaves(value)
    assert text == []
    assert [path.name for path in (tmp_path / "store" / "folder").iterdir()] == [f"key{codec.suffix}"]
    assert store.get("folder/other", codec) is None
    store.remove("folder/key", codec)
    store.remove("folder/key", codec)
    assert store.get("folder/key", codec) is None


class RunsOnLoad:
    def __reduce__(self):
        return (pytest.fail, ("a file was executed",))


@every_kind
def test_damaged_or_foreign_file_is_refused_and_replaced(case, tmp_path, request):
    codec, value = case
    store, text = store_in(tmp_path / "store")
    store.put("key", value, codec)
    path = store.path("key", codec)
    whole = path.read_bytes()
    middle = len(whole) // 2
    npz = tmp_path / "objects.npz"
    np.savez(npz, about=np.array([RunsOnLoad()], dtype=object))
    flipped = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
    for data in (whole[:-9], whole[:40], b"", flipped, pickle.dumps(RunsOnLoad()), npz.read_bytes(), b"\xff\xfe{}\n"):
        path.write_bytes(data)
        text.clear()
        assert leaves(store.get_or_make("key", lambda: value, codec)) == leaves(value)
        assert path.read_bytes() == whole
        (line,) = text
        assert str(path) in line
        assert line.endswith("made again")
        assert "\n" not in line
    kind = request.node.callspec.params["case"]
    foreign = {"flights": [flight(0.1, spec=spec) for spec in OTHER_SPECS], "json": {}, "section": {}}.get(kind, value)
    OTHERS[kind].write(path, foreign)
    text.clear()
    assert store.get("key", codec) is None
    assert len(text) == 1


def test_section_is_recomputed_if_its_plot_changed(tmp_path):
    picture, codec = tmp_path / "x.png", section_codec(tmp_path)
    picture.write_bytes(b"drawn")
    store, text = store_in(tmp_path)
    store.put("key", (TableSection((), (), picture=picture), []), codec)
    assert store.get("key", codec) is not None
    picture.write_bytes(b"of another table")
    assert store.get("key", codec) is None
    picture.unlink()
    assert store.get("key", codec) is None
    assert len(text) == 2


def test_incomplete_value_is_returned_but_not_stored(tmp_path):
    stop, called = threading.Event(), []
    store, _ = store_in(tmp_path, stop)
    codec = json_codec("note")
    hooks = {"on_reuse": lambda: called.append("reused"), "on_store": lambda: called.append("stored")}

    def half():
        stop.set()
        return {"half": 1}

    assert store.get_or_make("key", half, codec, **hooks) == {"half": 1}
    stop.clear()
    assert store.get_or_make("key", lambda: None, codec, **hooks) is None
    assert (called, store.get("key", codec)) == ([], None)
    assert store.get_or_make("key", lambda: {"whole": 2}, codec, **hooks) == {"whole": 2}
    assert store.get_or_make("key", half, codec, **hooks) == {"whole": 2}
    assert called == ["stored", "reused"]


def test_files_of_earlier_versions_are_tolerated(tmp_path):
    """Files with other names stay; a file with the name of a key is refused."""
    for name in ("sections/0123456789abcdef.json", "sections/0123456789abcdef.done", "sections/flights/k.npz"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(json.dumps({"section": {}, "rows": []}))
    store, text = store_in(tmp_path)
    assert store.get("sections/0123456789abcdef", section_codec(tmp_path)) is None
    assert store.get("sections/flights/k", flight_codec(SPECS)) is None
    assert len(text) == 2
    store.clear("sections/flights")
    assert {path.name for path in (tmp_path / "sections").iterdir()} == {"0123456789abcdef.json",
                                                                         "0123456789abcdef.done"}  # fmt: skip


def test_rows_are_json_lines_and_incomplete_line_is_skipped(tmp_path):
    store, _ = store_in(tmp_path)
    rows = [{"key": "a", "error": 0.1}, {"key": "b", "error": None}]
    store.put("flights", rows, rows_codec())
    path = Path(tmp_path / "flights.jsonl")
    assert [json.loads(line) for line in path.read_text().splitlines()] == rows
    path.write_text(path.read_text() + '{"key": "torn\n' + "[" * 100_000)
    assert store.get("flights", rows_codec()) == [*rows, None, None]
