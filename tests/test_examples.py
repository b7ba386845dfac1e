"""Every example runs, at reduced size, and prints finite numbers."""

import importlib.util
import math
import re
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|nan|inf)(?![\w])", re.IGNORECASE)


@pytest.mark.usefixtures("optax_promotion")
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(path, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    spec = importlib.util.spec_from_file_location(f"example_{path.stem}", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    example.main(quick=True)
    out = capsys.readouterr().out
    found = [float(word) for word in NUMBER.findall(out)]
    assert len(found) >= 2, out
    assert all(map(math.isfinite, found)), out
    assert not list(tmp_path.iterdir())


def test_there_are_examples():
    assert len(EXAMPLES) == 7
