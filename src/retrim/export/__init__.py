"""Export policies for computers without JAX: as NPZ with a NumPy runner, as ONNX, and as a C header."""
