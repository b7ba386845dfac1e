"""Files of an earlier flight return if the new flight does not begin, and are deleted if it does."""

import pytest

from retrim.runkit.earlier_outputs import EarlierOutputs

PATTERNS = ("flight.*", "results.json")


@pytest.fixture
def folder(tmp_path):
    for name in ("flight.csv", "results.json", "notes.txt"):
        (tmp_path / name).write_text(f"earlier {name}")
    return tmp_path


def contents(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_files_return_after_failed_start(folder):
    before = contents(folder)
    with EarlierOutputs(folder, PATTERNS):
        assert not (folder / "results.json").exists()
        assert (folder / "notes.txt").exists()
        (folder / "flight.csv").write_text("t")  # a header without a flight
    assert contents(folder) == before


def test_files_are_deleted_once_flight_has_begun(folder):
    with EarlierOutputs(folder, PATTERNS) as earlier:
        earlier.discard()
        (folder / "flight.csv").write_text("new")
    assert contents(folder) == {"flight.csv": "new", "notes.txt": "earlier notes.txt"}


def test_empty_folder_stays_empty(tmp_path):
    with EarlierOutputs(tmp_path, PATTERNS):
        assert not list(tmp_path.iterdir())
    assert not list(tmp_path.iterdir())
