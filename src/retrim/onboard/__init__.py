"""Control a vehicle in real time, using only NumPy and the standard library, without JAX or compilation."""
