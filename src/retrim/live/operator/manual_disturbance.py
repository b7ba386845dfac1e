"""Disturbances that the user applies to a simulated vehicle in flight: push, wind, load, weak rotor and kick."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from ...errors import MessageError, PlantError
from ...onboard.messages import pack_note, unpack_note
from ...onboard.note_fields import read_fields
from ...physics.disturbance import Disturbance, HeldEffects, SumOfDisturbances
from ...physics.effects import ExternalEffects
from ...physics.state import Command
from ...physics.vehicle import payload_inertia
from ...plants.plant import Measurement, Plant

PUSH, WIND, LOAD, WEAKEST = 4.0, 10.0, 5.0, 0.5  # [m/s^2], [m/s] per axis; [kg]; share of the thrust
KICK_S = 0.2  # [s], duration of a kick
KICK = 15.0  # [m/s^2], maximum per axis


@dataclass(frozen=True)
class ManualDisturbance:
    """Positions of the knobs. Their effects are added to the scenario's disturbance."""

    push: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """External acceleration in the world frame [m/s^2]."""
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Wind velocity in the world frame [m/s]."""
    load: float = 0.0
    """Mass of the payload under the vehicle [kg]."""
    rotor: float = 1.0
    """Share of its thrust that the front-right rotor retains."""
    kick: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Acceleration of the last kick in the world frame [m/s^2]."""
    kicks: int = 0
    """Number of kicks so far; an increase triggers a kick."""

    def __post_init__(self) -> None:
        """Raise :class:`MessageError` if the value of a knob is out of range or has the wrong type."""
        read_fields("knobs", vars(self))
        for name, values, bound in (("push", self.push, PUSH), ("wind", self.wind, WIND), ("kick", self.kick, KICK)):
            if not all(abs(v) <= bound for v in values):
                raise MessageError(f"knobs: {name} = {values} must be three numbers within +-{bound:g}")
        if not 0.0 <= self.load <= LOAD or not WEAKEST <= self.rotor <= 1.0 or self.kicks < 0:
            raise MessageError(
                f"knobs: load = {self.load} kg must be 0 to {LOAD:g}, rotor = {self.rotor} {WEAKEST:g} to 1"
            )

    def pack(self) -> bytes:
        """Return the bytes; the inverse of :meth:`unpack`."""
        return pack_note("knobs", **vars(self))

    @classmethod
    def unpack(cls, data: bytes) -> "ManualDisturbance":
        """Read the positions of the knobs.

        Raises:
            MessageError: The bytes are not knobs, or a knob is out of range.
        """
        fields = unpack_note(data, "knobs")
        try:
            push, wind, kick = (tuple(fields[name]) for name in ("push", "wind", "kick"))
            return cls(push, wind, fields["load"], fields["rotor"], kick, fields["kicks"])
        except KeyError as error:
            raise MessageError(f"knobs: {error} is missing") from error

    def effects(self, *, kicking: bool = False) -> ExternalEffects:
        """Return the effects on the vehicle, with or without the kick."""
        push = np.asarray(self.push) + (np.asarray(self.kick) if kicking else 0.0)
        gain = np.array([self.rotor, 1.0, 1.0, 1.0])
        inertia = payload_inertia(self.load) if self.load > 0 else np.zeros(3)
        parts = (push, np.asarray(self.wind), gain, self.load, inertia, np.zeros(3))
        return ExternalEffects(*(jnp.asarray(a) for a in parts))


class PlantWithKnobs:
    """Plant with knobs that may change in flight. The plant rejects unsupported knobs, and the flight continues."""

    def __init__(self, plant: Plant, disturbance: Disturbance) -> None:
        """Initialise with a plant; a user-defined plant without a ``disturb`` method has no knobs.

        Args:
            plant: The plant.
            disturbance: Disturbance of the scenario.
        """
        self.refusal = "" if hasattr(plant, "disturb") else "this plant has no knobs"
        """Reason why the last change of the knobs was rejected; empty if it was accepted."""
        self._plant, self._possible = plant, not self.refusal
        self._knobs, self._left = ManualDisturbance(), 0
        self._scenario = disturbance
        self._turn()

    def turn(self, knobs: ManualDisturbance) -> None:
        """Set the knobs; a kick begins if ``kicks`` has increased."""
        if knobs.kicks > self._knobs.kicks:
            self._left = round(KICK_S / self._plant.dt)
        self._knobs = knobs
        if self._possible:
            self.refusal = ""
        self._turn()

    def step(self, u: Command) -> tuple[Measurement, Command]:
        """Advance the plant by one tick.

        Raises:
            PlantError: The plant is lost.
        """
        try:
            done = self._plant.step(u)
        except PlantError as error:
            if not self._possible or self._knobs == ManualDisturbance(kicks=self._knobs.kicks):
                raise
            self.refusal, self._knobs, self._left = str(error), ManualDisturbance(kicks=self._knobs.kicks), 0
            self._turn()
            done = self._plant.step(u)
        if self._left:
            self._left -= 1
            if not self._left:
                self._turn()
        return done

    def _turn(self) -> None:
        if self._possible:
            effects = HeldEffects(self._knobs.effects(kicking=self._left > 0))
            self._plant.disturb(SumOfDisturbances((self._scenario, effects)))  # type: ignore[attr-defined]
