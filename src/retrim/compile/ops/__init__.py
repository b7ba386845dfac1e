"""Run compiled programs with JAX operations implemented in NumPy."""
