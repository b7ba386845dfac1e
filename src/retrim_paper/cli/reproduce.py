"""The command ``retrim reproduce``: one subcommand per table, with the options of the function that makes it."""

import inspect
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from retrim.cli.console import RichReporter, show_paths, started
from retrim.evaluation.cluster import joined
from retrim.runkit.run import Run

from .. import tables
from ..tables.quick import folder_of, help_of, looked, options_of

Ordered = Callable[[threading.Event], int]


def command_of(make: Callable[..., None], called: str = "reproduce") -> Callable[..., Ordered]:
    """Return a command with a table's options, and with ``out`` and ``on``.

    Args:
        make: Function that makes a document from a run and a reporter.
        called: Name of the command, used for the folder of its runs.
    """
    name, options = make.__name__, options_of(make)

    def command(*, out: Path | None = None, on: str | None = None, **chosen: Any) -> Ordered:
        def ordered(stop: threading.Event) -> int:
            (asked, remark), reporter = looked(make, chosen, sys.argv[1:]), RichReporter()
            folder = out or folder_of(make, quick=bool(chosen.get("quick")))
            with joined(on, reporter) as executor:
                run = started(Run(called, folder, stop=stop, remark=remark, executor=executor))
                make(run, reporter, **asked)
            show_paths(run.pages)
            return run.exit_code

        return ordered

    command.__name__ = name
    command.__doc__ = help_of(make)
    command.__annotations__ = {each.name: each.annotation for each in options}
    vars(command)["__signature__"] = inspect.Signature(options)
    return command


COMMANDS: dict[str, Callable[..., Ordered]] = {make.__name__: command_of(make) for make in tables.MADE} | {
    "all": command_of(tables.everything)
}
