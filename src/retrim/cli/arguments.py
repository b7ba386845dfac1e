"""Load and check the options of the commands: weights, presets and references, from files and names."""

import dataclasses
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any

from ..adapt.learner_state import LearnerState
from ..config.disturbances import DISTURBANCES
from ..config.faults import FAULTS, NO_FAULT
from ..config.loading import changed, load_for, overlaid, with_vehicle
from ..config.methods import METHODS
from ..config.plants import PLANTS, is_vehicle
from ..config.presets import Preset
from ..config.references import REFERENCES
from ..config.residuals import RESIDUALS
from ..config.scenario import THRUST_ERROR, Scenario
from ..config.sensors import SENSORS
from ..config.tasks import find_task
from ..config.vehicles import VEHICLES
from ..control.policy import AbstractPolicy
from ..errors import ConfigError
from ..io.checkpoint import load_delta
from ..io.policies import load_learner_state, load_policy
from ..plants.entry import DELAY
from .options import join_names, option


def load_inputs(
    policy: Path | None, resume: Path | None, delta: Path | None = None, *, trust: Collection[str] = ()
) -> tuple[AbstractPolicy, Preset, LearnerState | None]:
    """Return the weights, the preset, and the learner state of an earlier flight, if any.

    Args:
        policy: A policy, or the folder that contains one.
        resume: Learner state of an earlier flight, given instead of a policy.
        delta: A low-rank delta to add to the policy.
        trust: Python names that a file may contain, e.g. ``mine:task``.

    Raises:
        ConfigError: Both or neither of ``policy`` and ``resume`` are given, or ``delta`` together with ``resume``.
        CheckpointError: A file cannot be used.
    """
    if (policy is None) == (resume is None):
        raise ConfigError("give either --policy FILE or --resume FILE; `retrim pretrain hover --out h` makes h")
    if resume is not None:
        if delta is not None:
            raise ConfigError("--delta needs --policy; --resume contains its own")
        state, preset = load_learner_state(resume, trust=trust)
        return state.policy.policy.merged(), preset, state
    assert policy is not None
    weights, preset = load_policy(policy, trust=trust)
    return (load_delta(delta, weights).merged() if delta is not None else weights), preset, None


DISTURBANCE = (
    f"Disturbance of the flight: {join_names(DISTURBANCES)}; by default large, and none on a vehicle. A size may "
    "follow, as in wind=6 [m/s] or payload=0.2 [kg]. A sum combines several, as in wind+payload=0.1. Or module:name."
)
PLANT = (
    f"Plant: {join_names(PLANTS)}, or module:name; docs/plant.md describes them. A vehicle has an address: "
    "mavlink:udp:HOST:PORT, msp:serial:DEVICE:BAUD,pose=/TOPIC, crazyflie:udp:HOST:PORT, ros2:px4, ros:HOST:PORT."
)
REFERENCE = (
    f"Reference of a tracking policy: {join_names(REFERENCES)}, module:name, or a CSV file of t, x, y, z[, yaw]; by "
    "default the reference of its training. A closed file repeats as laps, any other is flown once; my.csv:laps and "
    "my.csv:once override this; circle=max sets the pace in flight. A new reference needs a policy that observes it."
)
VEHICLE = (
    f"Vehicle that the plant simulates: {join_names(VEHICLES)}, a vehicle file or module:name; by default the vehicle "
    "of training. rotorpy and crazyflow fly their own."
)
SENSOR = (
    f"Sensors that measure the state for the policy: {join_names(SENSORS)}, or module:name; docs/how-to/sensors.md "
    "lists their noise."
)
THRUST = "Relative thrust error; 0.1 means 10 % more thrust than commanded (bem, simple, second-order)."
LATE = "Command delay of the plant [s], unknown to the policy (bem, simple, second-order)."
FAULT = (
    f"Fault of the measurements, unknown to the policy (bem, simple, second-order): {join_names(FAULTS)}. A size may "
    "follow, as in late=3. Or module:name."
)
MEMORY = "Folder of a place, with the map (--residual place) of each vehicle for its next flight at this place."
METHOD = (
    f"Method of the flight: none, {join_names(f'{name} ({METHODS[name].label})' for name in METHODS)}; "
    f"{join_names(METHODS.plugins())} of installed packages; or module:name."
).replace("**", "")
RESIDUAL = f"Residual model: {join_names(RESIDUALS)}, or module:name; by default that of the policy."


@dataclasses.dataclass(frozen=True)
class FlightArguments:
    """The conditions of a flight, as command-line options."""

    disturbance: Annotated[str | None, option(DISTURBANCE, optional=True)] = None
    plant: Annotated[str, option(PLANT)] = "bem"
    reference: Annotated[str | None, option(REFERENCE, optional=True)] = None
    vehicle: Annotated[str | None, option(VEHICLE, optional=True)] = None
    sensors: Annotated[str, option(SENSOR)] = "ideal"
    thrust_error: Annotated[float, option(THRUST)] = THRUST_ERROR
    delay: Annotated[float, option(LATE)] = DELAY
    fault: Annotated[str, option(FAULT)] = NO_FAULT
    memory: Annotated[Path | None, option(MEMORY, optional=True)] = None

    @property
    def is_vehicle(self) -> bool:
        """Whether the plant is a vehicle, which runs in real time."""
        return is_vehicle(self.plant)

    def scenario(self, preset: Preset) -> Scenario:
        """Return the scenario for a policy.

        Raises:
            ConfigError: A name does not exist, or two options are incompatible.
            PlantError: A requirement of the plant is not installed.
        """
        usual = "none" if self.is_vehicle else "large"
        disturbance = usual if self.disturbance is None else self.disturbance
        follows = reference_of_flight(preset, self.reference)
        scenario = Scenario(disturbance, self.plant, self.vehicle, self.sensors, self.thrust_error,
                            follows, self.delay, self.fault)  # fmt: skip
        if scenario.entry.needs is not None:
            scenario.entry.needs()
        return scenario


def with_residual(preset: Preset, residual: str | None, state: LearnerState | None) -> Preset:
    """Return the preset with the given residual model; without one, return the preset unchanged.

    Raises:
        ConfigError: The residual model does not exist, or the flight resumes a learner state, which has its own model.
    """
    if residual is None:
        return preset
    if state is not None:
        raise ConfigError(f"--residual {residual}: a resumed flight keeps its own residual")
    return changed(preset, adapt={"residual": residual})


def reference_of_flight(preset: Preset, name: str | None) -> str | None:
    """Return the reference of a tracking flight, if it is one.

    Args:
        preset: Preset of the policy.
        name: Name of the reference; by default, the training reference.

    Raises:
        ConfigError: The policy cannot follow this reference.
    """
    if preset.track is None:
        if name is not None:
            raise ConfigError(f"--reference {name}: a {preset.task} policy follows no reference")
        return None
    training_reference = preset.track.reference
    if name is None and "+" in training_reference:
        raise ConfigError(f"the policy was trained on {training_reference}: choose one, as in --reference circle")
    if name is not None and name != training_reference and preset.track.observation == "blind":
        raise ConfigError(
            f"--reference {name}: this policy does not observe its reference, and was trained on {training_reference}"
        )
    return training_reference if name is None else name


def training_preset(
    task: str,
    preset: str | None = None,
    *,
    config: Path | None = None,
    vehicle: str | None = None,
    reference: str | None = None,
    residual: str | None = None,
    trust: Collection[str] = (),
    **pretrain: int | None,
) -> Preset:
    """Return the preset to train with.

    Args:
        task: Name of a task.
        preset: Name of a preset; by default the task's own.
        config: TOML file with values that replace those of the preset.
        vehicle: Vehicle to train for; overrides the preset and the file.
        reference: Reference to track; overrides the preset and the file.
        residual: Residual model for later adaptation; overrides the preset and the file.
        trust: Python names that the file may contain, e.g. ``mine:task``.
        **pretrain: Values for the table ``pretrain`` that override the preset and the file, except those that are None.

    Raises:
        ConfigError: A name, key or value is invalid.
    """
    entry = find_task(task)
    base = load_for(task, entry.default_preset if preset is None else preset)
    if config is not None:
        base = overlaid(base, config, trust=trust)
    if reference is not None:
        if not entry.has_reference:
            raise ConfigError(f"--reference {reference}: a {task} policy follows no reference")
        base = changed(base, track={**_table(base.track), "reference": reference})
    base = changed(base, pretrain={name: value for name, value in pretrain.items() if value is not None})
    if residual is not None:
        base = changed(base, adapt={"residual": residual})
    if vehicle is not None:
        base = with_vehicle(base, vehicle)
    return base


def _table(value: Any) -> dict[str, Any]:
    """Return a dataclass as a plain dictionary, or an empty dictionary for None."""
    return {} if value is None else dataclasses.asdict(value)
