"""From flights to rows of results."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..testbed import Setting
from .flights import Flight

METRICS = {"hover": "steady_error_m", "vision": "steady_error_m", "track": "tracking_error_m"}


def rows(flights: Sequence[Flight], *, task: str, setting: Setting) -> list[dict[str, Any]]:
    """One row of results per disturbance and method: mean and standard deviation over the starts that survived."""
    table = []
    for disturbance, method in dict.fromkeys((f.plan.disturbance, f.plan.method) for f in flights):
        group = [f for f in flights if (f.plan.disturbance, f.plan.method) == (disturbance, method)]
        steady = np.array([f.steady for f in group if not f.log.crashed])
        cross = [f.cross_track for f in group if not f.log.crashed and f.cross_track is not None]
        table.append(
            {
                "task": task,
                "plant": setting.plant,
                "vehicle": setting.flown,
                "sensing": setting.sensing,
                "disturbance": disturbance,
                "method": method,
                "metric": METRICS[task],
                "mean": float(steady.mean()) if len(steady) else None,
                "std": float(steady.std(ddof=1)) if len(steady) > 1 else None,
                **({"cross_track_m": float(np.mean(cross))} if cross else {}),
                "n": len(group),
                "crashes": sum(f.log.crashed for f in group),
            }
        )
    return table


def cell(row: dict[str, Any]) -> str:
    """Mean +- standard deviation [m], with crashes."""
    if row["mean"] is None:
        return f"crashed, {row['crashes']} of {row['n']}"
    text = f"{row['mean']:.3f}" + (f" ± {row['std']:.3f}" if row["std"] is not None else "")
    return text + (f", {row['crashes']} of {row['n']} crashed" if row["crashes"] else "")
