"""Controllers: policies and others."""

from .controller import AbstractController as AbstractController
from .controller import PolicyController as PolicyController
from .lora import LoraPolicy as LoraPolicy
from .policy import Policy as Policy
