"""Random motions near a goal, drawn without a roll-out; they give camera views before a policy's first flight."""

from typing import NamedTuple

from jax import random
from jaxtyping import Array, Float, Key

from ..physics import so3
from ..physics.state import State


class Motions(NamedTuple):
    """A distribution of states and body rates."""

    box: float
    """Largest distance between a position and the goal, per axis [m]."""
    tilt: float
    """Standard deviation of the attitude about each axis [rad]."""
    turn: float
    """Standard deviation of an additional change of heading [rad]."""
    speed: float
    """Standard deviation of the velocity, per axis [m/s]."""
    rates: float
    """Standard deviation of the body rates, per axis [rad/s]."""

    def draw(self, key: Key[Array, ""], goal: Float[Array, "3"]) -> tuple[State, Float[Array, "3"]]:
        """Draw a state and body rates [rad/s]; the key is consumed."""
        kp, kr, ky, kv, kw = random.split(key, 5)
        p = goal + random.uniform(kp, (3,), goal.dtype, minval=-self.box, maxval=self.box)
        leaning = so3.exp(self.tilt * random.normal(kr, (3,), goal.dtype))
        R = so3.rotz(self.turn * random.normal(ky, (), goal.dtype)) @ leaning
        v = self.speed * random.normal(kv, (3,), goal.dtype)
        return State(p, R, v), self.rates * random.normal(kw, (3,), goal.dtype)


NEAR = Motions(box=1.2, tilt=0.2, turn=0.4, speed=0.7, rates=1.0)
"""Motions of a hovering policy."""
WILD = Motions(box=1.5, tilt=0.5, turn=0.4, speed=2.0, rates=2.0)
"""Motions about as wide as those of the authors' random policy, on whose flights the authors pretrain."""
MOTIONS = {"near": NEAR, "wild": WILD}
"""Motions, by their names in presets."""
