"""Renders all tables as sections of text cells, and writes Markdown and JSON whenever a section is added."""

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import one_line
from .provenance import command_line, describe_code, describe_hardware
from .reporter import Reporter
from .run import Run

LONGEST_TEXT = 2000  # largest number of characters in a text


@dataclass(frozen=True)
class TableSection:
    """One table, as text."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    title: str = ""
    about: str = ""
    """Text above the table."""
    picture: Path | None = None
    """Picture below the table, in the document's folder."""

    def markdown(self) -> list[str]:
        """Return the section as lines of Markdown."""
        lines = [f"## {as_text(self.title)}", ""] if self.title else []
        lines += [_escape(self.about), ""] if self.about else []
        if self.rows:
            lines += ["| " + " | ".join(map(_cell, self.columns)) + " |", "|---" * len(self.columns) + "|"]
            lines += ["| " + " | ".join(map(_cell, row)) + " |" for row in self.rows] + [""]
        if self.picture is not None:
            lines += [f"![{as_text(self.title or self.picture.stem)}]({self.picture.name})", ""]
        return lines


def as_text(text: str) -> str:
    """Return a text on one line, escaped so that untrusted text cannot contain Markdown links or HTML."""
    return _escape(one_line(text, LONGEST_TEXT))


def _escape(text: str) -> str:
    return re.sub(r"<(?=[A-Za-z/!?])", "&lt;", text).replace("](", "]\\(")


class Link(str):
    """A cell that links to a page of the run; it is not escaped, so both parts must be names from this package."""

    @classmethod
    def to(cls, page: str, name: str) -> "Link":
        """Return the cell with the text ``name`` and the path ``page``."""
        return cls(f"[{name}]({page})")


def _cell(text: str) -> str:
    if isinstance(text, Link):
        return text
    return re.sub(r"(?<!\\)\|", r"\\|", as_text(text))


@dataclass
class Document:
    """``<name>.md`` and a JSON file in a run's folder; each section is written when it is added."""

    run: Run
    name: str
    title: str
    intro: str
    seeds: Sequence[int]
    reporter: Reporter
    more: dict[str, Any] = field(default_factory=dict)
    """Further values for the JSON file."""
    data: str | None = None
    """Name of the JSON file; by default the document's name."""
    sections: list[TableSection] = field(default_factory=list)
    """The sections so far."""
    files: list[Path] = field(default_factory=list)
    """Written files that a user opens: the page, its pictures, and others that were added."""
    _rows: list[dict[str, Any]] = field(default_factory=list)

    def add(self, section: TableSection, rows: Sequence[dict[str, Any]] = ()) -> None:
        """Add a section and its rows of results; write both files."""
        self.sections.append(section)
        self.files += [] if section.picture is None else [section.picture]
        self._rows += rows
        try:
            self.write()  # first, since printing may fail or be interrupted
        finally:
            self.reporter.say("\n".join(line for line in section.markdown() if not line.startswith("![")))

    def write(self) -> Path:
        """Write both files; return the path of the Markdown file.

        The page begins with the results. Commit, machine, command and run times are its last section.
        """
        remark = [self.run.remark, ""] if self.run.remark else []
        head = [f"# {as_text(self.title)}", "", self.intro, "", *remark]
        body = [line for section in self.sections for line in section.markdown()]
        foot = ["## Provenance", "", self._provenance(), ""]
        self.run.write_results(self._rows, seeds=self.seeds, name=self.data or self.name, **self.more)
        page = self.run.write_text(f"{self.name}.md", "\n".join([*head, *body, *foot]))
        if page not in self.run.pages:
            self.run.pages.append(page)
        if page not in self.files:
            self.files.insert(0, page)
        return page

    def _provenance(self) -> str:
        """Return the commit, the machine, the seeds, the command and the run times."""
        seed_note = f"; training seeds {', '.join(map(str, self.seeds))}" if self.seeds else ""
        command = as_text(command_line(sys.argv[1:])).replace("`", "'")
        text = f"{describe_code()}; {describe_hardware()}{seed_note}. Command: `{command}`. {self.run.watch.sentence()}"
        if self.run.interrupted:
            text += " Interrupted: incomplete."
        if self.run.reused:
            text += f" An earlier run had made {self.run.reused} of the parts; its time is not counted."
        return text
