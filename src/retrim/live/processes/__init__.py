"""Processes of a live flight that use JAX: plant, learners, identifier and bridge."""
