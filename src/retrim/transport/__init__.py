"""Serialises parameters to bytes, and provides the bus that carries them."""
