"""Parameters as bytes, and the bus that carries them."""
