"""Exports policies for computers without JAX: NPZ with a runner in NumPy, ONNX, and a C header."""
