"""retrim: re-train neural flight policies in seconds, in flight.

Pretrain a policy in a differentiable simulator and fly it on a plant. In flight, learn the simulator's error from the
last few seconds, re-train the policy in the corrected simulator, and replace it while the vehicle keeps flying.

Names are imported on first use, so that ``import retrim`` is fast. ``__init__.pyi`` lists them.
"""

import os
import sys
from importlib.metadata import version

import lazy_loader

# These variables take effect only if they are set before the first import of the package that reads them. Values set by
# the user are kept. XLA logs every program that its compile cache loads on a machine with different tuning flags.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# The crazyflow plant needs SciPy's array API, and reports an error if SciPy was imported before this variable was set.
if "scipy" not in sys.modules:
    os.environ.setdefault("SCIPY_ARRAY_API", "1")

__version__ = version("retrim")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
