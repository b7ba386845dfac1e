"""The command line: picks the command, sets up JAX, turns errors into one clear line and an exit code."""

import sys
from collections.abc import Callable

import tyro
from rich.markup import escape

from ..adapt.plant import PlantError
from ..checkpoint import PolicyError
from ..presets import PresetError
from . import bench, demo, doctor, fly, pretrain, reproduce
from .session import console, enable_compile_cache

COMMANDS: dict[str, Callable[..., int]] = {
    "pretrain": pretrain.pretrain,
    "fly": fly.fly,
    "demo": demo.demo,
    "bench": bench.bench,
    "reproduce": reproduce.reproduce,
    "doctor": doctor.doctor,
}


def main() -> None:
    """Run ``sys.argv``.

    Exit codes: 0 done, 1 refused with a message, 2 wrong usage, 130 interrupted, with what was done kept.
    """
    enable_compile_cache()
    try:
        code: int
        if sys.argv[1:2] == ["reproduce"]:
            code = tyro.extras.subcommand_cli_from_dict(
                reproduce.TABLES, prog="retrim reproduce", description="Make a table again.", args=sys.argv[2:]
            )
        else:
            code = tyro.extras.subcommand_cli_from_dict(
                COMMANDS, prog="retrim", description="Re-train neural flight policies in seconds, in flight."
            )
    except (PolicyError, PresetError, PlantError, OSError) as error:
        console.print(f"[bold red]retrim:[/] {escape(str(error))}", soft_wrap=True)
        code = 1
    except KeyboardInterrupt:
        console.print("interrupted")
        code = 130
    sys.exit(code)
