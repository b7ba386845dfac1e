"""Texts of the commands are printed literally: names and paths may look like markup or emoji of rich."""

import pytest

from retrim.cli.console import RichReporter, console, refuse, show_paths, show_table, warn
from retrim.runkit.document import TableSection

TEXT = "a[/red]/[bold]b[/]:x:.csv"


def advance(title):
    with RichReporter().progress(title) as report:
        report(1.0, TEXT)


PRINTS = {
    "say": lambda: RichReporter().say(TEXT),
    "progress": lambda: advance(TEXT),
    "refuse": lambda: refuse(TEXT),
    "warn": lambda: warn(TEXT),
    "path": lambda: show_paths([TEXT]),
    "title": lambda: show_table(TableSection(("x",), (("1",),), TEXT)),
    "column": lambda: show_table(TableSection((TEXT,), (("1",),))),
    "cell": lambda: show_table(TableSection(("x",), ((TEXT,), (f"**{TEXT}**",)))),
    "print": lambda: console.print(TEXT),
}


@pytest.mark.parametrize("in_terminal", [False, True])
@pytest.mark.parametrize("name", PRINTS)
def test_text_is_printed_literally(name, in_terminal, monkeypatch, capsys):
    monkeypatch.setattr(console, "_force_terminal", in_terminal)
    monkeypatch.setattr(console, "width", 160)
    PRINTS[name]()
    output = capsys.readouterr()
    assert TEXT in (output.err if name == "refuse" else output.out)
    assert "**" not in output.out
