"""Print the text and progress of the commands, to terminals and log files."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from ..errors import one_line, printable
from ..runkit.document import TableSection
from ..runkit.reporter import Advance
from ..runkit.run import Run

console, error_console = Console(highlight=False), Console(highlight=False, stderr=True)
Trust = tyro.conf.UseAppendAction[tuple[str, ...]]  # `--trust a:b --trust c:d`
LINE_EVERY = 10.0  # [s]: interval between progress lines if the output is not a terminal


class RichReporter:
    """Reporter with progress bars in a terminal, and periodic lines elsewhere."""

    def say(self, text: str) -> None:
        """Print plain text."""
        console.print(printable(text), markup=False, soft_wrap=True)

    @contextmanager
    def progress(self, title: str) -> Iterator[Advance]:
        """Show the progress of one task."""
        if not console.is_terminal:
            yield _lines(title)
            return
        columns = (
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(), TimeRemainingColumn(),
        )  # fmt: skip
        with Progress(*columns, console=console) as bars:
            bar = bars.add_task(title, total=1.0, note="")
            yield lambda share, note: bars.update(bar, completed=share, note=escape(printable(note)))


def _lines(title: str) -> Advance:
    """Return a function that prints a line at the start, at the end, and every ten seconds."""
    began, last = time.monotonic(), [float("-inf")]

    def advance(share: float, note: str) -> None:
        now = time.monotonic()
        if now - last[0] >= LINE_EVERY or share >= 1.0:
            last[0] = now
            console.print(
                f"{title}: {100 * share:.0f} %, {printable(note)}, {now - began:.0f} s", markup=False, soft_wrap=True
            )

    return advance


def report_start(run: Run) -> Run:
    """Print a message if a run resumes or overwrites an earlier run, and return the run."""
    if message := run.of_earlier():
        console.print(message, markup=False, soft_wrap=True)
    return run


def refuse(message: str) -> int:
    """Print an error on one line of the standard error, and return the exit code."""
    error_console.print(f"[bold red]retrim:[/] {escape(one_line(message))}", soft_wrap=True)
    return 1


def show_table(section: TableSection) -> None:
    """Print a table."""
    if section.title:  # on its own line, since a table wraps titles that are wider than itself
        console.print(f"[bold]{escape(section.title)}[/]", soft_wrap=True)
    table = Table()
    for column in section.columns:
        table.add_column(escape(column))
    for row in section.rows:
        table.add_row(*(_style(text) for text in row))
    console.print(table)


def show_paths(paths: Sequence[object]) -> None:
    """Print the paths of written files."""
    for path in paths:
        console.print(f"[bold]{escape(str(path))}[/]", soft_wrap=True)


def _style(text: str) -> str:
    """Convert bold text from Markdown to terminal markup."""
    return f"[bold]{escape(text.replace('**', ''))}[/]" if text.startswith("**") else escape(text)
