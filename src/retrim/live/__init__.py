"""Flight against the clock: processes for control, learning and the plant, and the bus between them."""
