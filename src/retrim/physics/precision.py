"""Set the precision of matrix products on accelerators at the first import; a user's choice takes precedence.

By default, GPUs round the factors of products to ten bits, so flights would differ from those on a CPU.
"""

import jax

if jax.config.values["jax_default_matmul_precision"] is None:
    jax.config.update("jax_default_matmul_precision", "float32")
