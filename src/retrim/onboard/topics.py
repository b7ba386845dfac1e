"""Names of the topics that are transmitted between machines."""

LAYERS = ("residual", "policy")
SLOTS = 2
"""Number of complete updates of each layer that the bus holds."""


def slot(layer: str, version: int) -> str:
    """Return the topic for an update of a layer."""
    return f"update.{layer}.{version % SLOTS}"


REFERENCE = "reference"
"""Part of a controller's parameters that defines its reference; learners do not change this part."""
VEHICLE = "vehicle"
"""Part of a controller's parameters that describes the vehicle and is identified during the flight."""
GIVEN_KINDS = (REFERENCE, VEHICLE)
"""Parts that stay in use when the learned parameters are not in use."""
OUTPUT_TOPICS = ("mission", "flight", "status", "ended", "learning", f"parameters.{REFERENCE}")
"""Topics from the flight to the learners."""
INPUT_TOPICS = (
    "ground",
    *(f"{what}.{layer}" for what in ("ready", "parameters", "said", "learner") for layer in LAYERS),
    *(slot(layer, i) for layer in LAYERS for i in range(SLOTS)),
)
"""Topics from the learners to the flight."""
SLOW_TOPICS = ("flight",)
"""Topics with messages on each tick, which the learners need only a few times per second."""
MOST_BYTES = 64 * 2**20
"""Size of the longest message between machines [bytes]."""
NETWORK_SIZES = dict.fromkeys((*OUTPUT_TOPICS, *INPUT_TOPICS), MOST_BYTES)
"""Size of the longest message on each topic between machines [bytes]."""
