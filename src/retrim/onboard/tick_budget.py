"""Division of a tick between the plant and control, so that the command arrives while the plant waits for it."""

PHASE = 0.1  # of a tick, by which the control process lags behind the plant
SHARE = 0.6  # of a tick: wait for a command; the remainder is for a simulation, or for the upkeep of a link
MARGIN = 0.1  # of a tick, for messages in transit and for a decision that takes longer than usual
ROOM = SHARE - PHASE - MARGIN  # of a tick: longest usual duration of a decision
