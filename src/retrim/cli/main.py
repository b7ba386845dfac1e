"""Select and run the command, and turn an error into a one-line message and an exit code.

Command modules are imported only when they are needed, so --help is fast.
"""

import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import entry_points
from types import FrameType

from ..errors import ConfigError, RetrimError
from ..jax_import import import_jax
from ..signals import handle_signals, stop_on_signal
from ..standard_outputs import tolerate_lost_outputs

PACKAGE = __name__.rpartition(".")[0]
COMMANDS = {
    "pretrain": "Train a policy from scratch in the nominal model and save it.",
    "fly": "Fly a policy on a plant, without and with adaptation in flight.",
    "sweep": "Fly presets x scenarios x seeds from a TOML file; one table and one picture.",
    "live": "Fly in real time and learn at the same time, in separate processes.",
    "learn": "Learn for a live flight on another machine.",
    "replay": "Read a flight log: errors of the model and of their predictions; identify, adapt.",
    "export": "Write a policy as NPZ, ONNX or C, for a computer without JAX.",
    "bench": "Measure the duration of each piece of work on this machine.",
    "doctor": "Show versions, device and cache, and check for known faults of dependencies.",
}
TRACEBACK = "--traceback"
GROUP = "retrim.commands"
"""Group of entry points that add commands: each is a dictionary from a name to its help text and module."""


def commands() -> dict[str, tuple[str, str]]:
    """Return the help text and module of every command, by name."""
    result = own_commands()
    for entry in entry_points(group=GROUP):
        try:
            result |= entry.load()
        except (Exception, SystemExit) as error:  # the other commands still work
            print(f"retrim: the commands of {entry.value} cannot be loaded: {error}", file=sys.stderr)
    return result


def own_commands() -> dict[str, tuple[str, str]]:
    """Return the help text and module of every command of this package, by name."""
    return {name: (about, f"{PACKAGE}.{name}") for name, about in COMMANDS.items()}


def describe(entries: Mapping[str, tuple[str, str]]) -> str:
    """Return the help text of the command line.

    Args:
        entries: Help text and module of every command, by name.
    """
    width = max(map(len, entries)) + 2
    return "\n".join(
        [
            "usage: retrim COMMAND [--help] [options]",
            "",
            "Re-train neural flight policies in seconds, in flight.",
            "",
            *(f"  {name:<{width}}{about}" for name, (about, _) in entries.items()),
            "",
            "  --version, --help",
            "  --traceback with any command: show the full traceback of an error",
            "",
            "Ctrl-C, SIGTERM or a closed terminal (SIGHUP) stops a command and keeps what is done.",
        ]
    )


def main(words: Sequence[str] | None = None) -> None:
    """Run a command and exit.

    Exit codes: 0 for success, 1 for an error with a message, 2 for wrong usage, 130 for an interruption. Results
    from before an interruption are kept. A closed or full standard output changes neither.

    Args:
        words: Command and options; by default, ``sys.argv``.
    """
    if words is not None:
        sys.argv = ["retrim", *words]  # results record this command line
    stop = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set():  # the second signal: an import may hang
            raise KeyboardInterrupt
        stop.set()  # an exception would break imports

    with tolerate_lost_outputs(), handle_signals(handle):
        code = _run(sys.argv[1:], stop)
    sys.exit(code)


def _run(words: list[str], stop: threading.Event) -> int:
    if not words or words[0] in ("--help", "-h"):
        print(describe(commands()))
        return 0 if words else 2
    if words[0] == "--version":
        from importlib.metadata import version

        print(f"retrim {version('retrim')}")
        return 0
    entries = own_commands() if words[0] in COMMANDS else commands()
    if words[0] not in entries:
        import difflib

        near = difflib.get_close_matches(words[0], entries, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        print(f"retrim: no command {words[0]!r}; {hint}there are {', '.join(entries)}", file=sys.stderr)
        return 2
    try:
        return _command(words[0], *entries[words[0]], words[1:], stop)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


@contextmanager
def _no_exit() -> Iterator[None]:
    """Refuse SystemExit, which no command of this package raises."""
    try:
        yield
    except SystemExit as end:
        raise RetrimError(f"a module of yours ended the command: SystemExit: {end.code}") from end


def _command(name: str, about: str, module: str, words: list[str], stop: threading.Event) -> int:
    import importlib

    import tyro

    try:
        import_jax()
    except ConfigError as error:
        print(f"retrim: {error}", file=sys.stderr)  # the console needs packages that import JAX
        return 1
    from ..runkit.compile_flags import compile_for
    from ..runkit.error_messages import describe_error
    from .console import console, refuse
    from .options import simplify_help
    from .usage import one_line_usage

    compile_for(name)
    full_traceback = TRACEBACK in words
    words = [word for word in words if word != TRACEBACK]
    try:
        with _no_exit():
            command = importlib.import_module(module)  # may be a user's
        prog, plain = f"retrim {name}", tyro.conf.configure(tyro.conf.AvoidSubcommands)
        with one_line_usage(prog):
            if hasattr(command, "COMMANDS"):
                entries = {n: plain(simplify_help(f)) for n, f in command.COMMANDS.items()}
                call = tyro.extras.subcommand_cli_from_dict(entries, prog=prog, description=about, args=words)
            else:
                call = tyro.cli(simplify_help(getattr(command, name)), prog=prog, args=words)
        with stop_on_signal(stop), _no_exit():
            code: int = call(stop)
    except Exception as error:
        if full_traceback:
            raise
        message = describe_error(error, words if name in COMMANDS else [*words, f"{module}:{name}"])
        if message is None:
            raise
        return refuse(message)
    if stop.is_set():
        console.print("interrupted; what was done is kept, if anything was")
        return code or 130
    return code
