"""``retrim reproduce``: a command for each table, with the options of the function that makes it."""

import inspect
import threading
from collections.abc import Callable
from inspect import Parameter
from pathlib import Path
from typing import Any

from ..experiments import tables
from ..experiments.run import Run
from .console import RichReporter, show_paths, started

Ordered = Callable[[threading.Event], int]
OUT = "    out: Folder of what is made; a new one under runs/ by default."


def command_of(make: Callable[..., None], called: str = "reproduce") -> Callable[..., Ordered]:
    """Return a command with the keyword-only options of ``make``, and ``out``.

    Args:
        make: It makes a document of its own name from a run and a reporter.
        called: Name of the command, for the folder of its runs.
    """
    name, signature = make.__name__, inspect.signature(make)
    options = [each for each in signature.parameters.values() if each.kind is Parameter.KEYWORD_ONLY]
    out = Parameter("out", Parameter.KEYWORD_ONLY, default=None, annotation=Path | None)

    def command(*, out: Path | None = None, **chosen: Any) -> Ordered:
        def ordered(stop: threading.Event) -> int:
            run = started(Run(called, out, stop=stop))
            make(run, RichReporter(), **chosen)
            show_paths([run.folder / f"{name}.md"])
            return run.exit_code

        return ordered

    command.__name__ = name
    command.__doc__ = f"{inspect.getdoc(make)}\n{OUT}"
    command.__annotations__ = {each.name: each.annotation for each in (*options, out)}
    vars(command)["__signature__"] = signature.replace(parameters=[*options, out], return_annotation=Parameter.empty)
    return command


COMMANDS: dict[str, Callable[..., Ordered]] = {make.__name__: command_of(make) for make in tables.MADE} | {
    "all": command_of(tables.everything)
}
