"""Every example runs, at reduced size, and prints finite numbers."""

import importlib.util
import math
import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "examples"
EXAMPLES = sorted(FOLDER.glob("0*.py"))
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|nan|inf)(?![\w])", re.IGNORECASE)


@pytest.mark.documentation
@pytest.mark.usefixtures("optax_promotion")
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    spec = importlib.util.spec_from_file_location(f"example_{path.stem}", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    example.main(quick=True)
    out = capsys.readouterr().out
    result = [float(word) for word in NUMBER.findall(out)]
    assert len(result) >= 2, out
    assert all(map(math.isfinite, result)), out
    assert not list(tmp_path.iterdir())


def test_every_file_belongs_to_an_example_or_page():
    assert [path.stem[:2] for path in EXAMPLES] == [f"0{i}" for i in range(1, 6)]
    docs = FOLDER.parent / "docs"
    pages = [*docs.glob("*.md"), *docs.glob("how-to/*.md")]
    text = "".join(path.read_text() for path in (*EXAMPLES, *pages))
    assert all(path.name in text for path in set(FOLDER.iterdir()) - set(EXAMPLES) if path.is_file())
