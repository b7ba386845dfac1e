"""What flies a vehicle in real time: NumPy and the standard library, no JAX, nothing that compiles or waits."""
