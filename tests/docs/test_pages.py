"""The code in the documentation runs, and its lists are complete."""

import dataclasses
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from fake_flights import flight
from retrim.cli.main import commands
from retrim.config.loading import overlaid
from retrim.config.named_presets import PRESETS
from retrim.config.vehicle_file import VehicleSpec, read_vehicle
from retrim.evaluation.metrics import CONDITIONS, failed_record, record, summary
from retrim.evaluation.sweep import Sweep, read_sweep
from retrim.io.logs import read_map
from retrim.io.logs.named_maps import names
from retrim.io.logs.plausibility import DOUBT_LIMITS, REFUSAL_LIMITS
from retrim.replay.report import WORDS

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [DOCS / "getting-started.md", DOCS / "presets.md"]
PAGES += [page for page in sorted((DOCS / "how-to").glob("*.md")) if "```python" in page.read_text()]
TOML = re.compile(r'^```toml title="(?P<title>[^"]+)"\n(?P<code>.*?)^```', re.M | re.S)


@pytest.fixture(scope="module")
def tracebacks(tmp_path_factory):
    """Return the traceback of each page, or None; one process runs all pages, since most of the time is compilation."""
    folder = tmp_path_factory.mktemp("reader")
    words = [sys.executable, str(Path(__file__).with_name("run_pages.py")), *map(str, PAGES)]
    process = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=900)
    assert process.returncode == 0, process.stderr
    return json.loads((folder / "pages.json").read_text())


@pytest.mark.documentation
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_blocks_of_page_run(tracebacks, page):
    assert tracebacks[str(page)] is None, tracebacks[str(page)]


@pytest.mark.parametrize(("page", "kind"), [("vehicle", VehicleSpec), ("sweep", Sweep)])
def test_page_lists_exactly_the_keys(page, kind):
    listed_rows = re.findall(r"^\| `(\w+)` \|", (DOCS / "how-to" / f"{page}.md").read_text(), re.M)
    assert sorted(listed_rows) == sorted(field.name for field in dataclasses.fields(kind))


def test_sweep_page_states_defaults():
    message = dict(re.findall(r"^\| `(\w+)` \| `([^`]+)` \|", (DOCS / "how-to" / "sweep.md").read_text(), re.M))
    plain = Sweep()
    assert set(message) == {field.name for field in dataclasses.fields(Sweep)} - {"seconds", "overlay"}
    for key, text in message.items():
        value = getattr(plain, key)
        assert json.loads(text) == (list(value) if isinstance(value, tuple) else value), key


def test_replay_page_states_limits_and_maps():
    page = (DOCS / "how-to" / "replay.md").read_text()
    rows = re.findall(r"^\| ([^|]+?) \| (-?\d* ?%?) ?\| (\d+) % \|$", page, re.M)
    for name, words in WORDS.items():
        (result,) = [row for row in rows if row[0].startswith(words)]
        refusal = f"{round(100 * REFUSAL_LIMITS[name])} %" if name in REFUSAL_LIMITS else ""
        assert result[1:] == (refusal, f"{round(100 * DOUBT_LIMITS[name])}")
    command = (ROOT / "src" / "retrim" / "replay" / "replay.py").read_text()
    for name in names():
        assert f"`{name}`" in page
        assert name in command


def test_first_page_states_figures_of_results():
    plain = summary([record(flight(0.1))])
    tracking = summary(
        [record(flight(0.1, cross=np.full(501, 0.1))), failed_record(flight(0.1).spec, "small", "e", "no")]
    )
    page = (DOCS / "getting-started.md").read_text()
    message = {name for row in re.findall(r"^\| (`[^|]+) \|", page, re.M) for name in re.findall(r"`(\w+)`", row)}
    assert (plain | tracking).keys() - {*CONDITIONS, "metric"} <= message


def test_toml_files_of_pages_are_valid(tmp_path):
    readers = {
        "my_quad": read_vehicle,
        "slow": read_vehicle,
        "my_log": read_map,
        "rates": read_map,
        "study": read_sweep,
        "track100": lambda path: overlaid(PRESETS["track/preview"], path),
        "laps": lambda path: overlaid(PRESETS["track/retrim"], path),
        "excite": lambda path: overlaid(PRESETS["hover/any"], path),
        "east": lambda path: tomllib.loads(path.read_text()),
    }
    result = {block["title"]: block["code"] for page in PAGES for block in TOML.finditer(page.read_text())}
    assert set(readers) == {Path(title).stem for title in result}
    for title, code in result.items():
        (tmp_path / title).write_text(code)
        readers[Path(title).stem](tmp_path / title)


def test_commands_of_documents_exist():
    display = set[str]()
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.glob("*.md"), *(DOCS / "how-to").glob("*.md")):
        for block in re.finditer(r"^```(?P<kind>[^\n]*)\n(?P<text>.*?)^```$", page.read_text(), re.M | re.S):
            if not block["kind"]:
                display |= set(re.findall(r"^(?:\.venv/bin/)?retrim ([a-z]+)", block["text"], re.M))
    assert display <= set(commands())
    assert {"pretrain", "fly", "sweep"} <= display


def test_every_preset_is_described():
    listed_rows = re.findall(r"^\| `(\w+/\w+)` \|", (DOCS / "presets.md").read_text(), re.M)
    assert sorted(listed_rows) == sorted(PRESETS)
