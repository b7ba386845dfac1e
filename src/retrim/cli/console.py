"""Print the text and progress of the commands, to terminals and log files."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from ..errors import one_line, printable
from ..runkit.document import TableSection
from ..runkit.reporter import Advance
from ..runkit.run import Run

# No markup: values from files and paths may contain brackets.
console, error_console = (Console(highlight=False, markup=False, emoji=False, stderr=x) for x in (False, True))
Trust = tyro.conf.UseAppendAction[tuple[str, ...]]  # `--trust a:b --trust c:d`
LINE_EVERY = 10.0  # [s]: interval between progress lines if the output is not a terminal


class RichReporter:
    """Reporter with progress bars in a terminal, and periodic lines elsewhere."""

    def say(self, text: str) -> None:
        """Print plain text."""
        console.print(printable(text), soft_wrap=True)

    @contextmanager
    def progress(self, title: str) -> Iterator[Advance]:
        """Show the progress of one task."""
        if not console.is_terminal:
            yield _lines(title)
            return
        columns = (
            TextColumn("{task.description}", markup=False), BarColumn(),
            TextColumn("{task.fields[note]}", markup=False), TimeElapsedColumn(), TimeRemainingColumn(),
        )  # fmt: skip
        with Progress(*columns, console=console) as bars:
            bar = bars.add_task(title, total=1.0, note="")
            yield lambda share, note: bars.update(bar, completed=share, note=printable(note))


def _lines(title: str) -> Advance:
    """Return a function that prints a line at the start, at the end, and every ten seconds."""
    began, last = time.monotonic(), [float("-inf")]

    def advance(share: float, note: str) -> None:
        now = time.monotonic()
        if now - last[0] >= LINE_EVERY or share >= 1.0:
            last[0] = now
            console.print(f"{title}: {100 * share:.0f} %, {printable(note)}, {now - began:.0f} s", soft_wrap=True)

    return advance


def report_start(run: Run) -> Run:
    """Print a message if a run resumes or overwrites an earlier run, and return the run."""
    if message := run.describe_earlier():
        console.print(message, soft_wrap=True)
    return run


def refuse(message: str) -> int:
    """Print an error on one line of the standard error, and return the exit code."""
    error_console.print(Text.assemble(("retrim:", "bold red"), " ", one_line(message)), soft_wrap=True)
    return 1


def warn(message: str) -> None:
    """Print a warning."""
    console.print(Text.assemble(("warning:", "yellow"), " ", printable(message)), soft_wrap=True)


def show_table(section: TableSection) -> None:
    """Print a table."""
    if section.title:  # on its own line, since a table wraps titles that are wider than itself
        console.print(section.title, style="bold", soft_wrap=True)
    table = Table()
    for column in section.columns:
        table.add_column(column)
    for row in section.rows:
        table.add_row(*(_style(text) for text in row))
    console.print(table)


def show_paths(paths: Sequence[object]) -> None:
    """Print the paths of written files."""
    for path in paths:
        console.print(str(path), style="bold", soft_wrap=True)


def _style(text: str) -> Text:
    """Convert bold text from Markdown to terminal text."""
    return Text(text.replace("**", ""), "bold") if text.startswith("**") else Text(text)
