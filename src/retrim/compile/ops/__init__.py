"""Runtime of compiled programs: operations of JAX in NumPy."""
