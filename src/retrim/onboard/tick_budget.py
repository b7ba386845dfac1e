"""Divide each tick between the plant and control so that the command arrives while the plant waits for it."""

PHASE = 0.1  # of a tick, by which the control process lags behind the plant
SHARE = 0.6  # of a tick, for which the plant waits for a command; the rest is for the simulation or the link
MARGIN = 0.1  # of a tick, for messages in transit and for a decision that takes longer than usual
ROOM = SHARE - PHASE - MARGIN  # of a tick: longest usual duration of a decision
