"""Serialise parameters to bytes, and provide the bus that carries these bytes."""
