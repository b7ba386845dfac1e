"""Who decides: policies and other controllers."""

from .controller import AbstractController as AbstractController
from .controller import PolicyController as PolicyController
from .lora import LoraPolicy as LoraPolicy
from .policy import Policy as Policy
