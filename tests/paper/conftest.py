"""Tables that train and fly nothing, and draw nothing."""

import pytest

from helpers import brief_preset
from made_up import Imaginary
from retrim.config import named_presets


@pytest.fixture
def presets(monkeypatch):
    for name in ("hover/retrim", "hover/fast", "hover/paper"):
        monkeypatch.setitem(named_presets.PRESETS, name, brief_preset(name))


@pytest.fixture
def imagine(monkeypatch, presets):
    """Let a table's module train and fly nothing."""

    def made(table, error):
        found = Imaginary(error)
        for name, stands_in in (("train_all", found.train), ("fly_all", found.fly)):
            monkeypatch.setattr(table, name, stands_in)
        return found

    return made


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Pictures that are not drawn: what was asked for, by the name of the function."""
    asked = {}

    def watch(table, *names):
        for name in names:

            def draw(*words, name=name, **more):
                asked.setdefault(name, []).append((words, more))
                files = (tmp_path / "picture.png", tmp_path / "picture.svg")
                for path in files:
                    path.touch()
                return files

            monkeypatch.setattr(table, name, draw)
        return asked

    return watch
