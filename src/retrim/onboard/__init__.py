"""Real-time control of a vehicle. It uses NumPy and the standard library, and neither JAX nor compilation."""
