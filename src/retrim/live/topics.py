"""Topics of a live flight and their maximum message lengths."""

from ..onboard.messages import COLUMNS
from ..onboard.topics import LAYERS, REFERENCE, SLOTS, slot
from .roles import ROLES
from .spec import LiveSpec

SMALL_TOPICS = ("sample", "setpoint", "fallback", "order", "ended", "world", "knobs", "wish", "learning", "ground",
         "airborne", "followed", "identified", "refusals.page", "refusals.network")  # fmt: skip


def topics(spec: LiveSpec) -> dict[str, int]:
    """Return the maximum message length of each topic [bytes]."""
    half = {name: sum(a.nbytes for a in arrays.values()) for name, arrays in spec.controller.parameters.items()}
    rows = 8 * len(COLUMNS) * spec.window + 10_000
    # Leave room for a policy with its optimiser's moments, even if the current method learns only a low-rank delta.
    state_size = spec.start.stat().st_size + 3 * half.get("policy", 0) + 200_000
    beating = [name for name, role in ROLES.items() if role.restarts]
    return (
        dict.fromkeys(SMALL_TOPICS, 4096)
        | {"status": 65536, "stalls": 16384, "flight": rows, "fallback.flight": rows}
        | {f"ready.{role}": 8192 for role in ROLES}
        | {f"beat.{role}": 1024 for role in ("supervisor", *beating)}
        | {f"parameters.{name}": size + 100_000 for name, size in ({REFERENCE: 0} | half).items()}
        | {"mission": state_size}
        | {slot(layer, i): state_size for layer in LAYERS for i in range(SLOTS)}
        | {f"{what}.{layer}": 8192 for what in ("said", "learner") for layer in LAYERS}
    )
