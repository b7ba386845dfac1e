"""A file that cannot be written to its folder is written to a different folder, with a message."""

import errno
import os

import numpy as np
import pytest

from retrim import ConfigError
from retrim.io.files import write_whole
from retrim.io.logs.recording import quaternions
from retrim.runkit.outlet import Outlet
from retrim.runkit.run import Run


@pytest.fixture
def outlet(tmp_path):
    setup = Outlet(tmp_path / "out")
    setup.spare = tmp_path / "full", tmp_path / "spare"
    return setup


def test_writable_file_is_in_its_folder(outlet):
    assert outlet.write("a file", lambda folder: write_whole(folder / "a", "1")) is None
    assert (outlet.folder / "a").read_text() == "1"
    assert outlet.faults == []
    assert not any(folder.exists() for folder in outlet.spare)


def test_full_disk_writes_to_other_folder_with_message(outlet):
    def put(folder):
        if folder.name != "spare":
            raise OSError(errno.ENOSPC, "No space left on device")
        write_whole(folder / "a", "1")
        return folder / "a"

    assert outlet.write("a file", put) == outlet.spare[1] / "a"
    assert outlet.faults == [
        f"a file cannot be written to {outlet.folder} (No space left on device); it is in {outlet.spare[1]}"
    ]
    assert not outlet.spare[0].exists()
    assert os.stat(outlet.spare[1]).st_mode & 0o077 == 0


def test_unwritable_file_is_reported_and_others_are_written(outlet):
    def put(folder):
        raise OSError(errno.EIO, "Input/output error")

    assert outlet.write("a file", put) is None
    assert outlet.faults == [
        f"a file cannot be written to {outlet.folder} (Input/output error), nor to any temporary folder"
    ]


def test_results_in_temporary_folder_state_reason(outlet):
    run = Run("fly", outlet.folder)
    outlet.folder.parent.mkdir(exist_ok=True)
    outlet.folder.write_text("a file of that name")
    path = outlet.write_results(run, [], seeds=[0])
    assert path == outlet.spare[0] / "results.json"
    assert outlet.faults == [f"results.json cannot be written to {outlet.folder} (File exists); it is in {path.parent}"]
    assert run.folder == outlet.folder
    with pytest.raises(ConfigError, match="results cannot be written there"):
        Run("fly", outlet.folder)


def test_full_disk_error_names_file(tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device") as error_info:
        write_whole(tmp_path / "a", "1")
    assert error_info.value.filename == str(tmp_path / "a")


def test_failure_of_one_output_is_reported_and_others_are_written(outlet):
    """For example, the name of a Matplotlib back end in the environment is wrong."""

    def put(folder):
        raise ValueError("no back end of this name")

    assert outlet.write("the picture", put) is None
    assert outlet.faults == ["the picture cannot be made (ValueError: no back end of this name)"]
    assert outlet.write_results(Run("fly", outlet.folder), [], seeds=[0]) == outlet.folder / "results.json"


def test_quaternions_of_attitudes_that_are_not_finite_are_nan():
    rows = np.zeros((3, 15))
    rows[:, 3:12] = np.eye(3).ravel()
    rows[1, 5] = np.nan
    np.testing.assert_array_equal(quaternions(rows)[[0, 2]], [[0.0, 0.0, 0.0, 1.0]] * 2)
    assert np.isnan(quaternions(rows)[1]).all()
