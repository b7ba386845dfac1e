"""``retrim replay``: replay a flight log."""

import threading
from collections.abc import Callable
from pathlib import Path

import tyro

from ..replay.replay import Replay
from ..replay.replay import replay as replayed
from ..runkit.run import Run
from .console import RichReporter, report_start, show_paths


def replay(
    log: tyro.conf.Positional[Path],
    request: tyro.conf.OmitArgPrefixes[tyro.conf.UseAppendAction[Replay]] = Replay(),  # noqa: B008
    out: Path | None = None,
) -> Callable[[threading.Event], int]:
    """Read a flight log, report the nominal model's error and its predictability, and identify or adapt.

    Args:
        log: CSV, NPZ, Blackbox, dataflash, PX4 ULog, ROS bag or MCAP file; the last three need the extra `logs`.
        request: Options of the replay.
        out: Folder for the report, its picture, vehicle.toml and the policy; by default, a new one under runs/.
    """

    def execute(stop: threading.Event) -> int:
        run = report_start(Run("replay", out, stop=stop))
        show_paths(replayed(log, request, run, RichReporter()).files)
        return run.exit_code

    return execute
