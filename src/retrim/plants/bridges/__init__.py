"""Links to vehicles that are not ours to simulate: autopilots, and firmware in the place of a rate controller."""
