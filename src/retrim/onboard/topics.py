"""Names of topics that are transmitted between machines."""

LAYERS = ("residual", "policy")
SLOTS = 2
"""Number of complete updates of each layer that stay on the bus."""


def slot(layer: str, version: int) -> str:
    """Return the topic of an update."""
    return f"update.{layer}.{version % SLOTS}"


REFERENCE = "reference"
"""Parameters of a controller that define its reference; learners do not change them."""
VEHICLE = "vehicle"
"""Parameters of a controller that describe the vehicle; they are identified during the flight."""
UNLEARNED = (REFERENCE, VEHICLE)
"""Parameters that stay in use when the learned parameters are not used."""
OUT = ("mission", "flight", "status", "ended", "learning", f"parameters.{REFERENCE}")
"""Topics from the flight to the learners."""
INTO = (
    "ground",
    *(f"{what}.{layer}" for what in ("ready", "parameters", "said", "learner") for layer in LAYERS),
    *(slot(layer, i) for layer in LAYERS for i in range(SLOTS)),
)
"""Topics from the learners to the flight."""
SLOWLY = ("flight",)
"""Topics that are published each tick, although the learners need them only a few times per second."""
MOST = 64 * 2**20
"""Size of the longest message between machines [bytes]."""
