"""retrim: re-train neural flight policies in seconds, in flight.

Pretrain a policy in a differentiable simulator, fly it on a plant, learn from the last seconds of flight what the
simulator missed, re-train the policy in the corrected simulator, and swap it in, while the vehicle keeps flying.

Names are imported when they are first used, so that ``import retrim`` is quick. ``__init__.pyi`` lists them.
"""

import os
import sys
from importlib.metadata import version

import lazy_loader

# All must be set before the package that reads them is first imported; a value of the user's stands.
# XLA reports every program that its compile cache loads on a machine whose tuning flags differ.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# GPUs round the factors of products to ten bits unless told otherwise: flights would not be those of a CPU.
os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "float32")
# The plant crazyflow needs SciPy to follow the array API, and says so where SciPy came first.
if "scipy" not in sys.modules:
    os.environ.setdefault("SCIPY_ARRAY_API", "1")

__version__ = version("retrim")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
