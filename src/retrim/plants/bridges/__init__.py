"""Links to vehicles outside the simulation: autopilots, and firmware that replaces the rate controller."""
