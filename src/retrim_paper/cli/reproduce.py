"""The command ``retrim reproduce``: one subcommand per table, with the options of the function that makes it."""

import inspect
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from retrim.cli.console import RichReporter, report_start, show_paths
from retrim.evaluation.cluster import join_cluster
from retrim.runkit.run import Run

from .. import tables
from ..tables.quick import folder_of, help_of, options_of, quick_options

Order = Callable[[threading.Event], int]


def command_of(make: Callable[..., None], called: str = "reproduce") -> Callable[..., Order]:
    """Return a command with a table's options, and with ``out`` and ``on``.

    Args:
        make: Function that makes a document from a run and a reporter.
        called: Name of the command, used for the folder of its runs.
    """
    name, options = make.__name__, options_of(make)

    def command(*, out: Path | None = None, on: str | None = None, **options: Any) -> Order:
        def execute(stop: threading.Event) -> int:
            (request, remark), reporter = quick_options(make, options, sys.argv[1:]), RichReporter()
            folder = out or folder_of(make, quick=bool(options.get("quick")))
            with join_cluster(on, reporter) as executor:
                run = report_start(Run(called, folder, stop=stop, remark=remark, executor=executor))
                make(run, reporter, **request)
            show_paths(run.pages)
            return run.exit_code

        return execute

    command.__name__ = name
    command.__doc__ = help_of(make)
    command.__annotations__ = {each.name: each.annotation for each in options}
    vars(command)["__signature__"] = inspect.Signature(options)
    return command


COMMANDS: dict[str, Callable[..., Order]] = {make.__name__: command_of(make) for make in tables.TABLES} | {
    "all": command_of(tables.everything)
}
