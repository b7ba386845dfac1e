"""Policies for computers without JAX: NPZ with a runner of NumPy, ONNX, and a C header."""
