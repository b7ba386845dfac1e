"""``retrim reproduce``: a command for each table, with the options of the function that makes it."""

import inspect
import threading
from collections.abc import Callable
from inspect import Parameter
from pathlib import Path
from typing import Any

from ..experiments import tables
from ..experiments.run import Run
from ..experiments.tables.quick import help_of, looked, options_of
from .console import RichReporter, show_paths, started

Ordered = Callable[[threading.Event], int]


def command_of(make: Callable[..., None], called: str = "reproduce") -> Callable[..., Ordered]:
    """Return a command with the options of a table, and ``out``.

    Args:
        make: It makes a document of its own name from a run and a reporter.
        called: Name of the command, for the folder of its runs.
    """
    out_option = Parameter("out", Parameter.KEYWORD_ONLY, default=None, annotation=Path | None)
    name, options = make.__name__, [*options_of(make), out_option]

    def command(*, out: Path | None = None, **chosen: Any) -> Ordered:
        def ordered(stop: threading.Event) -> int:
            asked, remark = looked(make, chosen)
            run = started(Run(called, out, stop=stop, remark=remark))
            make(run, RichReporter(), **asked)
            show_paths([run.folder / f"{name}.md"])
            return run.exit_code

        return ordered

    command.__name__ = name
    command.__doc__ = f"{help_of(make)}\n    out: Folder of what is made; a new one under runs/ by default."
    command.__annotations__ = {each.name: each.annotation for each in options}
    vars(command)["__signature__"] = inspect.Signature(options)
    return command


COMMANDS: dict[str, Callable[..., Ordered]] = {make.__name__: command_of(make) for make in tables.MADE} | {
    "all": command_of(tables.everything)
}
