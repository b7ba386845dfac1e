"""Parameters as bytes."""

from .wire import pack as pack
from .wire import unpack as unpack
