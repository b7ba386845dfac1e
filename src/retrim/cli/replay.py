"""``retrim replay``: replay a flight log."""

import threading
from collections.abc import Callable
from pathlib import Path

import tyro

from ..replay.replay import Replay
from ..replay.replay import replay as replayed
from ..runkit.run import Run
from .console import RichReporter, show_paths, started

LEFT = ("replay.md", "replay.png", "vehicle.toml", "adapted.safetensors", "delta.safetensors")


def replay(
    log: tyro.conf.Positional[Path],
    asked: tyro.conf.OmitArgPrefixes[tyro.conf.UseAppendAction[Replay]] = Replay(),  # noqa: B008
    out: Path | None = None,
) -> Callable[[threading.Event], int]:
    """Read a flight log, report the nominal model's error and its predictability, and identify or adapt.

    Args:
        log: Log file: CSV, NPZ, PX4 ULog, ROS 1 or 2 bag, or MCAP; the last three need the extra `logs`.
        asked: Options of the replay.
        out: Folder for the report, its picture, vehicle.toml and the policy; by default, a new one under runs/.
    """

    def ordered(stop: threading.Event) -> int:
        run = started(Run("replay", out, stop=stop))
        replayed(log, asked, run, RichReporter())
        show_paths([path for name in LEFT if (path := run.folder / name).is_file()])
        return run.exit_code

    return ordered
