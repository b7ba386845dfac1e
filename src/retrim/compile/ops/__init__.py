"""Runtime of compiled programs: JAX operations in NumPy."""
