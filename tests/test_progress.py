"""Progress of calls from Python: a bar in a notebook or a terminal, and no output elsewhere."""

import os
import pty
import subprocess
import sys
import threading
import types

import pytest

from retrim.progress import no_progress, show_progress

SCRIPT = """
from retrim.progress import show_progress
with show_progress("flying") as advance:
    advance(0.5, "[red] 5 of 10 s")
    advance(1.0, "10 of 10 s")
print("over")
"""


def test_process_without_terminal_prints_nothing():
    result = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert (result.stdout, result.stderr) == ("over\n", "")


def test_terminal_shows_bar_on_standard_error():
    reader, writer = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT],
        stdout=subprocess.PIPE,
        stderr=writer,
        text=True,
        env={**os.environ, "TERM": "xterm"},
    )
    out, _ = process.communicate(timeout=60)
    os.close(writer)
    display = os.read(reader, 65536).decode()
    os.close(reader)
    assert out == "over\n"
    assert "flying" in display
    assert "[red] 5 of 10 s" in display
    assert "10 of 10 s" in display


class Display:
    """The output of one cell."""

    HTML = str

    def __init__(self):
        self.texts = []

    def display(self, text, *, display_id):
        self.texts.append(text)
        return self

    def update(self, text):
        self.texts.append(text)


@pytest.fixture
def cell(monkeypatch):
    """Return the display of a process that imitates a notebook kernel."""
    display = Display()
    kernel = types.SimpleNamespace(display=display, get_ipython=lambda: types.SimpleNamespace(kernel=None))
    monkeypatch.setitem(sys.modules, "IPython", kernel)
    return display


def test_notebook_shows_bar_and_removes_it_at_end(cell):
    def run_interrupted():
        with show_progress("flying") as advance:
            advance(0.25, "<b>")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_interrupted()
    assert 'value="0.250"' in cell.texts[1]
    assert "25 %, &lt;b&gt;" in cell.texts[1]
    assert cell.texts[-1] == ""


def test_bar_shows_first_last_and_few_other_steps(cell):
    with show_progress("flying") as advance:
        for tick in range(1001):
            advance(tick / 1000, f"{tick}")
    assert "0 %, 0" in cell.texts[1]
    assert "100 %, 1000" in cell.texts[-2]
    assert len(cell.texts) < 100


def test_other_threads_and_no_progress_show_nothing(cell):
    def work():
        with show_progress("flying") as advance:
            advance(0.5, "half")

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    with no_progress("flying") as advance:
        advance(0.5, "half")
    assert cell.texts == []


def test_lost_terminal_does_not_end_work(cell, monkeypatch):
    def lose(text):
        raise OSError(5, "Input/output error")

    with show_progress("flying") as advance, monkeypatch.context() as patch:
        patch.setattr(cell, "update", lose)
        advance(0.5, "half")
