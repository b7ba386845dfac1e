"""Real-time control of a vehicle. It uses only NumPy and the standard library, without JAX or compilation."""
