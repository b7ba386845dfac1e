"""Progress bars for calls from Python: only in a notebook or a terminal."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from html import escape
from typing import Any

Advance = Callable[[float, str], None]
"""Receives the completed share (0 to 1) and a short text."""
Progress = Callable[[str], AbstractContextManager[Advance]]
"""Takes the title of a task and returns a context manager whose value receives the progress of the task."""
INTERVAL = 0.2  # [s], shortest time between two updates of a bar


def no_progress(title: str) -> AbstractContextManager[Advance]:
    """Ignore the progress.

    Args:
        title: Title of the task.
    """
    return nullcontext(_ignore)


@contextmanager
def show_progress(title: str) -> Iterator[Advance]:
    """Show a bar in a notebook or a terminal until the task ends, but not in other processes and threads.

    Args:
        title: Title of the task.
    """
    if threading.current_thread() is not threading.main_thread():
        yield _ignore
    elif _is_notebook():
        with _notebook_bar(title) as advance:
            yield _at_intervals(advance)
    elif sys.stderr is not None and sys.stderr.isatty():
        with _terminal_bar(title) as advance:
            yield _at_intervals(advance)
    else:
        yield _ignore


def _ignore(share: float, text: str) -> None:
    """Ignore the progress."""


def _is_notebook() -> bool:
    """Return whether this process is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell is not None and hasattr(shell, "kernel")


@contextmanager
def _notebook_bar(title: str) -> Iterator[Advance]:
    """Show a bar in the output of a cell. The bar of rich needs ipywidgets, which a notebook may lack."""
    display = sys.modules["IPython"].display
    handle = display.display(display.HTML(""), display_id=True)

    def advance(share: float, text: str) -> None:
        bar = f'<progress value="{share:.3f}" max="1"></progress>'
        handle.update(display.HTML(f"{escape(title)} {bar} {100 * share:.0f} %, {escape(text)}"))

    try:
        yield advance
    finally:
        handle.update(display.HTML(""))


@contextmanager
def _terminal_bar(title: str) -> Iterator[Advance]:
    """Show a bar on the standard error, and remove it at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns: tuple[Any, ...] = (
        TextColumn("{task.description}", markup=False), BarColumn(),
        TextColumn("{task.fields[note]}", markup=False), TimeElapsedColumn(),
    )  # fmt: skip
    # Without a refresh thread, which would compete with a flight in real time.
    with Progress(*columns, console=Console(stderr=True), auto_refresh=False, transient=True) as bars:
        task = bars.add_task(title, total=1.0, note="")
        yield lambda share, text: bars.update(task, completed=share, note=text, refresh=True)


def _at_intervals(advance: Advance) -> Advance:
    """Return a function that passes on the first progress, the last one, and one in each interval."""
    last = float("-inf")

    def pass_on(share: float, text: str) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= INTERVAL or share >= 1.0:
            last = now
            with suppress(OSError):  # a lost terminal must not end a flight
                advance(share, text)

    return pass_on
