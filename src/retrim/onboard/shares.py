"""How a tick is divided between plant and control, so that an answer comes while somebody waits for it."""

PHASE = 0.1  # of a tick, by which the process that flies is behind the plant
SHARE = 0.6  # of a tick, for which a command is waited for; the rest is for a simulation, or for the upkeep of a link
MARGIN = 0.1  # of a tick, for messages on their way and for a decision that takes longer than it usually does
ROOM = SHARE - PHASE - MARGIN  # of a tick, that a decision usually takes at most
