"""Controllers: learned policies and other control laws."""

from .controller import AbstractController as AbstractController
from .controller import PolicyController as PolicyController
from .lora import LoraPolicy as LoraPolicy
from .network_policy import NetworkPolicy as NetworkPolicy
from .policy import AbstractPolicy as AbstractPolicy
from .policy import Policy as Policy
