"""Precision of matrix products on accelerators, which the first import of this package sets; a user's choice stands.

By default, GPUs round the factors of products to ten bits, so that flights would differ from those on a CPU.
"""

import jax

if jax.config.values["jax_default_matmul_precision"] is None:
    jax.config.update("jax_default_matmul_precision", "float32")
