"""Pilot of the control process, which runs a controller as NumPy programs and swaps its parameters in flight."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..compile.ops.program import Arrays, NumpyProgram, ProgramSource
from .messages import STATE, Parameters
from .topics import GIVEN_KINDS, VEHICLE

PACE_CHANGE_TIME = 0.4  # [s], time during which the pace of a clock changes, as in retrim.tasks.paced_reference
BLEND = 5  # ticks over which the pilot fades out a jump in the command at a swap


@dataclass(frozen=True)
class ControllerSource:
    """A controller and the structure of its parameters, prepared before take-off."""

    init: ProgramSource
    """(parameters, state) -> memory."""
    decide: ProgramSource
    """(parameters, [memory, time, age, state]) -> command, stage of the controller and its cause, phase along the
    reference [s], pace and its relative growth [1/s], memory."""
    accepted: ProgramSource
    """(parameters, [memory, command]) -> memory, if the plant accepted a command that differs from the issued one."""
    target: ProgramSource
    """(parameters, time along the reference) -> target position of the vehicle."""
    predicted: ProgramSource
    """(parameters, [state, command]) -> acceleration that the corrected model predicts."""
    parameters: Mapping[str, Mapping[str, Any]]
    """Initial parameters, by part (``policy``, ``residual``, ``reference``, ``vehicle``) and name, in the order of the
    programs."""
    base: str
    """Hash of the programs and of the shapes of their parameters."""
    dtype: np.dtype[Any]
    """Floating-point type of the computation."""


class LivePilot:
    """Runs one controller, tick by tick."""

    def __init__(self, source: ControllerSource) -> None:
        self._source = source
        self._init, self._decide = NumpyProgram(source.init), NumpyProgram(source.decide)
        self._acceptance, self._target = NumpyProgram(source.accepted), NumpyProgram(source.target)
        self._prediction = NumpyProgram(source.predicted)
        self._parameters = {half: list(arrays.values()) for half, arrays in source.parameters.items()}
        self.versions = dict.fromkeys(source.parameters, 0)
        self._policies: dict[int, Arrays] = {0: self._parameters["policy"]}  # the last proven policy and all later ones
        self._backup: tuple[dict[str, Arrays], dict[str, int], dict[int, Arrays]] | None = None
        self._memory: Arrays = []
        self.condition = 0, 0
        """Stage of the controller's degradation, and its cause; see :mod:`retrim.control.condition`."""
        self._clock = 0.0, 0.0, 1.0, 0.0
        self._prepared = self._prepare()
        self._old = self._prepared[1]
        self._jump, self._left, self._just_swapped = np.zeros(4), 0, False

    def reset(self, x: np.ndarray) -> None:
        """Start a flight in the state ``x``, a vector of p, R by rows and v."""
        self._memory = self._init.step(self._prepared[0], self._state(x))
        self._left, self._just_swapped, self._jump = 0, False, np.zeros(4)
        self.condition, self._clock = (0, 0), (0.0, 0.0, 1.0, 0.0)

    def task_time(self, t: float) -> float:
        """Return the time along the reference at flight time ``t`` [s], which equals ``t`` at a constant pace of 1.

        Args:
            t: Time since the start of the flight, at most a few ticks after the last command [s].
        """
        begin, phase, pace, growth = self._clock
        tau = t - begin
        growing = min(tau, PACE_CHANGE_TIME)
        return phase + pace * (tau + growth * growing * (tau - 0.5 * growing))

    def target(self, t: float) -> np.ndarray:
        """Return the vehicle's target position in the world frame [m] at flight time ``t`` [s]."""
        return np.asarray(self._target.step(self._prepared[4], [self._scalar(self.task_time(t))])[0], dtype=float)

    def act(self, t: float, age: float, x: np.ndarray) -> np.ndarray:
        """Return the command [c, omega] for a new measurement.

        Args:
            t: Time since the start of the flight [s].
            age: Age of the measurement [s].
            x: Measured state: p, R by rows, v.
        """
        inputs = [self._scalar(t), self._scalar(age), *self._state(x)]
        decide, memory = self._prepared[1], self._memory
        c, omega, stage, cause, phase, pace, growth, *self._memory = self._decide.step(decide, [*memory, *inputs])
        self.condition = int(stage), int(cause)
        self._clock = t, float(phase), float(pace), float(growth)
        u = np.concatenate([[c], omega]).astype(float)
        if self._just_swapped:
            before, rates, *_ = self._decide.step(self._old, [*memory, *inputs])
            going = np.concatenate([[before], rates]).astype(float) + self._jump * self._left / BLEND
            self._jump, self._left, self._just_swapped = going - u, BLEND, False
        if self._left:
            u = u + self._jump * self._left / BLEND
            self._left -= 1
            self.accept(u)
        return u

    def rehearse(self, t: float, age: float, x: np.ndarray) -> None:
        """Compute a command and discard it; the pilot's memory does not change."""
        self._decide.step(self._prepared[1], [*self._memory, self._scalar(t), self._scalar(age), *self._state(x)])

    def accept(self, u: np.ndarray) -> None:
        """Correct the memory if the plant accepted ``u`` instead of the last issued command."""
        command = [self._scalar(u[0]), u[1:].astype(self._source.dtype)]
        self._memory = self._acceptance.step(self._prepared[2], [*self._memory, *command])

    def predict(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the acceleration that the corrected model predicts in the world frame [m/s^2]."""
        command = [self._scalar(u[0]), u[1:].astype(self._source.dtype)]
        return np.asarray(self._prediction.step(self._prepared[3], [*self._state(x), *command])[0], dtype=float)

    def swap(self, parameters: Parameters) -> None:
        """Use new parameters from the next tick on.

        The pilot blends the old command into that of the new controller within a few ticks. It does not blend after new
        vehicle parameters, because the controller itself follows these parameters slowly.
        """
        half = parameters.half
        self._parameters[half] = list(parameters.arrays.values())
        self.versions[half] = parameters.version
        if half == "policy":
            self._policies[parameters.version] = self._parameters[half]
        if half == VEHICLE:
            self._prepared = self._prepare()
        else:
            self._change()

    def restart(self) -> None:
        """Use the learned parameters from take-off again, starting with the next tick."""
        self._backup = self._parameters, self.versions, self._policies
        reference = {half: leaves for half, leaves in self._parameters.items() if half in GIVEN_KINDS}
        first = {half: list(arrays.values()) for half, arrays in self._source.parameters.items()}
        self._parameters = first | reference
        self.versions = {half: self.versions[half] if half in GIVEN_KINDS else 0 for half in first}
        self._policies = {0: self._parameters["policy"]}
        self._change()

    def resume(self) -> None:
        """Use the learned parameters from before :meth:`restart` again."""
        if self._backup is not None:
            (parameters, versions, self._policies), self._backup = self._backup, None
            self._parameters |= {half: leaves for half, leaves in parameters.items() if half not in GIVEN_KINDS}
            self.versions |= {half: version for half, version in versions.items() if half not in GIVEN_KINDS}
            self._change()

    def expected(self, half: str) -> Mapping[str, Any]:
        """Return the initial parameters of a part, which define the expected shapes and types."""
        return self._source.parameters[half]

    def confirm(self, version: int) -> None:
        """Record that a policy has flown long enough without harm, and discard the earlier policies."""
        self._policies = {v: leaves for v, leaves in self._policies.items() if v >= version}

    def back(self) -> list[int]:
        """Roll back to the last proven policy; return the abandoned versions."""
        version = min(self._policies)
        withdrawals = sorted(v for v in self._policies if v > version)
        self._policies = {version: self._policies[version]}
        self._parameters["policy"], self.versions["policy"] = self._policies[version], version
        self._change()
        return withdrawals

    def _change(self) -> None:
        if not self._just_swapped:
            self._old = self._prepared[1]
        self._prepared, self._just_swapped = self._prepare(), True

    def _prepare(self) -> tuple[Arrays, ...]:
        programs = (self._init, self._decide, self._acceptance, self._prediction, self._target)
        return tuple(program.prepare(self._flat()) for program in programs)

    def _flat(self) -> Arrays:
        return [leaf[()] for half in self._parameters.values() for leaf in half]

    def _scalar(self, value: float) -> Any:
        return self._source.dtype.type(value)

    def _state(self, x: np.ndarray) -> Arrays:
        x = x.astype(self._source.dtype)
        return [x[:3], x[3:12].reshape(3, 3), x[12:STATE]]
