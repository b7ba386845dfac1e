"""Fixtures for tables without training, flights and plots."""

import pytest

from fake_flights import Imaginary
from helpers import brief_preset
from retrim.config import named_presets


@pytest.fixture
def presets(monkeypatch):
    for name in ("hover/retrim", "hover/fast", "hover/paper"):
        monkeypatch.setitem(named_presets.PRESETS, name, brief_preset(name))


@pytest.fixture
def imagine(monkeypatch, presets):
    """Replace training and flights of a table's module by made-up results."""

    def make(table, error):
        result = Imaginary(error)
        for name, stands_in in (("train_all", result.train), ("fly_all", result.fly)):
            monkeypatch.setattr(table, name, stands_in)
        return result

    return make


@pytest.fixture
def pictures(monkeypatch, tmp_path):
    """Replace plotting; return the arguments of each plot by the name of its function."""
    calls = {}

    def watch(table, *names):
        for name in names:

            def draw(*words, name=name, **more):
                calls.setdefault(name, []).append((words, more))
                files = (tmp_path / "picture.png", tmp_path / "picture.svg")
                for path in files:
                    path.touch()
                return files

            monkeypatch.setattr(table, name, draw)
        return calls

    return watch
