"""Names of topics that travel between machines."""

LAYERS = ("residual", "policy")
SLOTS = 2
"""Whole updates of each layer that stay on the bus."""


def slot(layer: str, version: int) -> str:
    """Return the topic of an update."""
    return f"update.{layer}.{version % SLOTS}"


REFERENCE = "reference"
"""Half of the parameters of a controller that says what it follows; no learner changes it."""
VEHICLE = "vehicle"
"""Half of the parameters of a controller that says which vehicle it flies; it is identified beside the flight."""
UNLEARNED = (REFERENCE, VEHICLE)
"""Halves that stay when what was learnt is not flown."""
OUT = ("mission", "flight", "status", "ended", "learning", f"parameters.{REFERENCE}")
"""Topics from the flight to the learners."""
INTO = (
    "ground",
    *(f"{what}.{layer}" for what in ("ready", "parameters", "said", "learner") for layer in LAYERS),
    *(slot(layer, i) for layer in LAYERS for i in range(SLOTS)),
)
"""Topics from the learners to the flight."""
SLOWLY = ("flight",)
"""Topics that come with each tick, though a few times a second are enough for those who learn."""
MOST = 64 * 2**20
"""Longest message between machines [bytes]."""
