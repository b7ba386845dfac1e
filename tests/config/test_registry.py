"""Names: registered names, names imported from a user's module, and unknown names."""

import math
import subprocess
import sys
import textwrap
import types
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import tiny_preset
from retrim import ConfigError
from retrim.config import Scenario, Setup, changed, disturbance, load, registry
from retrim.config.disturbances import DISTURBANCES
from retrim.config.plants import PLANTS
from retrim.config.references import REFERENCES, make_reference
from retrim.config.registry import Registry
from retrim.config.residuals import RESIDUALS
from retrim.config.sensors import SENSORS
from retrim.config.tasks import TASKS
from retrim.config.vehicles import VEHICLES
from retrim.physics import Command, State
from retrim.runtime import FunctionPilot, fly

REGISTRIES = {
    "vehicle": VEHICLES,
    "disturbance": DISTURBANCES,
    "sensor": SENSORS,
    "plant": PLANTS,
    "task": TASKS,
    "reference": REFERENCES,
    "residual": RESIDUALS,
}

MINE = """
import jax.numpy as jnp
from retrim import Hover, PlantEntry, SimPlant, TaskEntry
from retrim.learn import EnsembleModel
from retrim.physics import Constant, LinearDragQuadrotor, small
from retrim.plants import SensorModel
from retrim.tasks import Reference

NUMBER = 3


class Higher(Hover):
    def error(self, t, x):
        return x.p[2]


def task(request):
    observation = request.state_observation()
    goal = jnp.array([0.0, 0.0, request.options["height"]])
    return Higher(goal, observation, jnp.array(5.0), jnp.array(0.3), request.preset.dt, request.preset.pretrain.horizon)


entry = TaskEntry(task, "hover/paper")


def no_task(request):
    raise ValueError("a task of mine needs a height")


def plant(request):
    '''A plant of mine.

    More about it.
    '''
    model = LinearDragQuadrotor.of(request.vehicle, request.dt, thrust_error=request.thrust_error)
    return SimPlant(model, request.disturbance, sensors=request.sensors, seed=request.seed)


plant_entry = PlantEntry(plant, "a plant of mine", own_vehicle="mine")


def gust(key, size):
    if size is not None and size > 5.0:
        raise ValueError("no more than 5 m/s^2")
    return Constant(jnp.array([1.0 if size is None else size, 0.0, 0.0]))


class Zero(EnsembleModel):
    pass


def residual(request):
    return Zero(jnp.array(request.preset.goal), request.vehicle.omega_max, jnp.array(0.1), jnp.array(0.0), steps=2)


def no_disturbance(key, size):
    return size


def no_residual(request):
    return 3


def vehicle():
    return small()


def no_vehicle():
    return "a vehicle"


def sensors():
    return SensorModel.of(position=0.5)


def reference():
    return Reference.of(lambda t: [0.0, 0.0, 1.0 + 0.1 * t], seconds=5.0)
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Return a user's module in the current folder, under a unique name."""
    name = f"mine_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(textwrap.dedent(MINE))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p not in ("", str(tmp_path))])
    yield name
    sys.modules.pop(name, None)


# ---- the registry itself


def test_name_is_registered_once():
    things = Registry("thing", example="module:name")
    assert things.register("one", abs) is abs
    assert things.find("one") is things["one"] is abs
    with pytest.raises(ConfigError, match="thing 'one' is already registered"):
        things.register("one", max)
    with pytest.raises(ConfigError, match="thing 'one' is already registered"):
        things.register_place("one", "builtins:max")
    assert things.find("one") is abs
    assert list(things) == ["one"]
    assert len(things) == 1


def test_module_is_imported_at_first_use(mine):
    sys.path.append(str(Path.cwd()))
    things = Registry("thing", example="module:name", expected="a plant")
    things.register_place("late", f"{mine}:plant")
    things.register("now", abs)
    things.register_place("number", f"{mine}:NUMBER")
    assert (list(things), len(things), "late" in things) == (["late", "now", "number"], 3, True)
    assert mine not in sys.modules
    assert things.find("late") is sys.modules[mine].plant is things["late"]
    assert list(things) == ["late", "now", "number"]
    with pytest.raises(ConfigError, match="thing 'number' is a int, not a plant"):
        things.find("number")


def test_links_are_imported_at_first_use():
    code = "import sys; import retrim.config; print([m for m in sys.modules if m.startswith('retrim.plants.bridges.')])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize("kind", REGISTRIES)
def test_object_of_wrong_type_is_refused(kind):
    with pytest.raises(ConfigError, match=rf"{kind} 'math:pi' is a float, not an? "):
        REGISTRIES[kind].find("math:pi")
    with pytest.raises(ConfigError, match=rf"{kind} 'pi' is a float, not an? "):
        REGISTRIES[kind].register("pi", math.pi)
    assert "pi" not in REGISTRIES[kind]


@pytest.mark.parametrize("name", ["", "a:b", "a+b", "a=b", "a b", "a\n"])
def test_invalid_names_are_refused(name):
    with pytest.raises(ConfigError, match="must not be empty nor contain"):
        Registry("thing", example="module:name").register(name, abs)


@pytest.mark.parametrize("kind", REGISTRIES)
def test_unknown_name_lists_names_and_nearest(kind):
    model = REGISTRIES[kind]
    nearest = max(model, key=len)
    with pytest.raises(ConfigError, match=rf"no {kind} '{nearest}x'; did you mean '{nearest}'\? there are ") as error:
        model.find(nearest + "x")
    for name in model:
        assert name in str(error.value)
    assert "module:name" in str(error.value)
    assert "\n" not in str(error.value)
    with pytest.raises(ConfigError, match=f"no {kind} 'qqqqqq'; there are"):
        model.find("qqqqqq")


def test_installed_packages_add_names(monkeypatch):
    calls = []

    def entry_points(group):
        calls.append(group)
        return [types.SimpleNamespace(name="theirs", load=lambda: abs)]

    monkeypatch.setattr(registry, "entry_points", entry_points)
    assert VEHICLES.find("theirs") is abs
    assert calls == ["retrim.vehicles"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no_such_module:thing", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("{mine}:nothing", "AttributeError: .*has no attribute 'nothing'"),
        ("broken:thing", "ZeroDivisionError: division by zero"),
        ("unfinished:thing", "SyntaxError: "),
        ("refusing:thing", "RuntimeError: not today"),
        ("leaving:thing", "SystemExit: 0"),
    ],
)
def test_module_that_cannot_be_imported_is_refused(mine, tmp_path, text, message):
    (tmp_path / "broken.py").write_text("1 / 0")
    (tmp_path / "unfinished.py").write_text("def thing(:")
    (tmp_path / "refusing.py").write_text("raise RuntimeError('not today')")
    (tmp_path / "leaving.py").write_text("import sys; sys.exit(0)")
    name = text.format(mine=mine)
    with pytest.raises(ConfigError, match=f"vehicle '{name}' cannot be imported: {message}"):
        VEHICLES.find(name)


@pytest.mark.parametrize(
    "name", ["mine:", ":thing", "a+b:thing", "mine:thing.part", "a.:b", "../mine:thing", "mine :a"]
)
def test_invalid_python_names_are_refused(name):
    with pytest.raises(ConfigError, match="a Python name has the form module:name"):
        VEHICLES.find(name)


# ---- a user's own objects


def test_custom_task(mine):
    preset = changed(tiny_preset(), task=f"{mine}:task", options={"height": 2.5})
    setup = Setup.from_preset(preset)
    assert type(setup.env.task).__name__ == "Higher"
    np.testing.assert_array_equal(setup.flight_task.home(), [0.0, 0.0, 2.5])
    assert setup.env.task.horizon == preset.pretrain.horizon
    assert setup.learner.env.task is setup.flight_task
    assert float(setup.flight_starts(1)[0].p[2]) == pytest.approx(2.5, abs=1.0)
    entry = changed(tiny_preset(), task=f"{mine}:entry", options={"height": 2.5})
    assert type(Setup.from_preset(entry).env.task).__name__ == "Higher"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("NUMBER", "is a int, not a function"),
        ("no_task", "needs a height"),
        ("no_residual", "returns int, expected a retrim.AbstractTask"),
    ],
)
def test_invalid_custom_task_is_refused(mine, name, message):
    with pytest.raises(ConfigError, match=message):
        Setup.from_preset(changed(tiny_preset(), task=f"{mine}:{name}"))


def test_custom_plant_vehicle_sensors_and_disturbance(mine):
    scenario = Scenario(f"{mine}:gust=2.5+none", f"{mine}:plant", f"{mine}:vehicle", f"{mine}:sensors")
    assert scenario.entry.about == "A plant of mine."
    plant = scenario.make(dt=0.01, seed=3)
    assert plant.dt == 0.01
    log = fly(plant, FunctionPilot(lambda m: Command.hover()), State.at(jnp.array([0.0, 0.0, 1.0])), ticks=20)
    assert log.v[-1, 0] == pytest.approx(0.5, rel=0.05)  # 2.5 m/s^2 for 0.2 s
    assert 0.2 < (log.measured.p - log.p).std() < 0.8
    own = Scenario(plant=f"{mine}:plant_entry")
    assert own.vehicle_name("small") == "mine"
    with pytest.raises(ConfigError, match="flies its own vehicle, mine"):
        Scenario(plant=f"{mine}:plant_entry", vehicle="large")


def test_size_refused_by_custom_disturbance(mine):
    with pytest.raises(ConfigError, match=rf"disturbance '{mine}:gust=7': no more than 5"):
        disturbance(f"{mine}:gust=7")


def test_invalid_custom_plant_is_refused(mine):
    with pytest.raises(ConfigError, match="is a int, not a function of a PlantRequest"):
        Scenario(plant=f"{mine}:NUMBER")
    with pytest.raises(ConfigError, match=r"returns int, expected a retrim\.Plant"):
        Scenario(plant=f"{mine}:no_residual").make()


def test_invalid_custom_disturbance_is_refused(mine):
    with pytest.raises(ConfigError, match=rf"disturbance '{mine}:no_disturbance=2' returns float, expected a retrim"):
        disturbance(f"{mine}:no_disturbance=2")


def test_invalid_custom_vehicle_is_refused(mine):
    with pytest.raises(ConfigError, match=r"returns str, expected a retrim\.Vehicle"):
        Scenario(vehicle=f"{mine}:no_vehicle").make()
    with pytest.raises(ConfigError, match="vehicle"):
        Setup.from_preset(changed(tiny_preset(), vehicle=f"{mine}:NUMBER"))


def test_custom_residual(mine):
    setup = Setup.from_preset(changed(tiny_preset(), adapt={"residual": f"{mine}:residual"}))
    assert type(setup.learner.residual_model).__name__ == "Zero"
    assert setup.learner.residual_model.steps == 2
    state = setup.learner.init(setup.new_policy(random.key(0)), random.key(1))
    assert isinstance(state.residual, eqx.Module)
    with pytest.raises(ConfigError, match="returns int without init, fit and predict"):
        Setup.from_preset(changed(tiny_preset(), adapt={"residual": f"{mine}:no_residual"}))


def test_custom_reference(mine):
    result = make_reference(f"{mine}:reference")
    np.testing.assert_allclose(result(jnp.array(2.0)).p, [0.0, 0.0, 1.2], atol=1e-6)
    setup = Setup.from_preset(changed(load("track/paper"), pretrain={"hidden_sizes": (8,)}), f"{mine}:reference")
    np.testing.assert_allclose(setup.flight_task.reference(jnp.array(2.0)).p, [0.0, 0.0, 1.2], atol=1e-6)
    with pytest.raises(ConfigError, match=r"reference 'circle': a hover policy follows no reference"):
        Setup.from_preset(tiny_preset(), "circle")
    with pytest.raises(ConfigError, match=rf"reference '{mine}:no_vehicle' is a str, not a function that returns"):
        make_reference(f"{mine}:no_vehicle")
    with pytest.raises(ConfigError, match=rf"reference {mine}:no_task: "):
        make_reference(f"{mine}:no_task")
    with pytest.raises(ConfigError, match=r"nowhere\.csv: No such file or directory"):
        make_reference("nowhere.csv")
