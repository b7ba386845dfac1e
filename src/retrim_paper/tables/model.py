"""Compares the blade-element plant's curves and figures with published ones."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from retrim.config.disturbances import disturbance
from retrim.config.vehicles import VEHICLES
from retrim.physics.bem import BemQuadrotor, BemState
from retrim.physics.effects import ExternalEffects
from retrim.physics.propeller import five_inch, vortex_ring
from retrim.physics.state import STANDARD_GRAVITY, Command, State
from retrim.physics.substep import SUBSTEP, RotorState
from retrim.runkit.document import Document, TableSection
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run
from retrim.viz import plots
from retrim.viz.panels import Curve, Panel, panel_figure

from ..published import GOLDEN_HOVER, SteadyRotor, compare_published, steady_rotor

DT = 0.02  # [s]
QUADROTORS = ("small", "large", "kingfisher")  # vehicles shown; a user may have registered others
PUBLISHED_MAP = 1.562522e-6  # [N s^2], thrust map of the 5.1 in rotors (Agilicious)


def model(run: Run, reporter: Reporter) -> None:
    """Curves and figures of the blade-element plant: thrust, drag, inflow, rate and thrust steps, and battery sag.

    Args:
        run: Folder for model.md, model.json, model.png and model.svg.
        reporter: Receives progress and the table.
    """
    reporter.say("computing the curves of the blade-element model")
    panels = [thrust_panel(), drag_panel(), inflow_panel(), rate_panel(), step_panel(), sag_panel()]
    picture_path, _ = plots.save(panel_figure("The plant bem", panels), run.folder, "model")
    table = compare_published()
    lines = tuple(
        (
            row["what"],
            f"{row['ours']:.5g}",
            f"{row['published']:.5g}",
            f"{100 * (row['ours'] / row['published'] - 1):+.1f} %",
            row["source"],
        )
        for row in table
    )
    title = "The blade-element plant compared with published figures"
    document = Document(run, "model", title, "Made by `retrim reproduce model`.", [0], reporter)
    document.add(
        TableSection(("quantity", "here", "published", "deviation", "source"), lines, picture=picture_path), table
    )


def thrust_panel() -> Panel:
    """Plot the 5.1 in rotor's thrust in still air, with the published thrust map."""
    speeds = np.linspace(200.0, 2300.0, 30)
    ours = np.array([SteadyRotor(five_inch(), float(w), 0.0, 0.0).thrust for w in speeds])
    points = np.array(GOLDEN_HOVER)
    return Panel(
        "Hover thrust, 5.1 in rotor",
        "rotor speed [rad/s]",
        "thrust [N]",
        [
            Curve(speeds, ours, "blade elements"),
            Curve(speeds, PUBLISHED_MAP * speeds**2, "published thrust map", dashed=True),
            Curve(points[:, 0], points[:, 1], "Agilicious' own model", marks=True, color=2),
        ],
    )


def drag_panel() -> Panel:
    """Plot a level vehicle's deceleration at hover thrust against its speed."""
    curves, speeds = list[Curve](), np.linspace(0.0, 10.0, 41)
    for i, name in enumerate(("small", "kingfisher")):
        bem = BemQuadrotor.of(VEHICLES[name](), DT)
        result = np.array([_drag(bem, float(v)) for v in speeds])
        curves.append(Curve(speeds, result[:, 0], f"{name}: rotors and body", color=i))
        curves.append(Curve(speeds, result[:, 1], f"{name}: rotors", dashed=True, color=i))
    curves.append(Curve(np.array([0.0, 8.0]), 0.24 * np.array([0.0, 8.0]), "kingfisher, published: 0.24 1/s", color=2))
    return Panel("Drag of the level vehicle", "speed [m/s]", "deceleration [m/s²]", curves)


def _drag(bem: BemQuadrotor, speed: float) -> tuple[float, float]:
    x = State(jnp.zeros(3), jnp.eye(3), jnp.array([speed, 0.0, 0.0]))
    s = _init(bem, x)
    total = float(_force(bem, s, ExternalEffects.calm(x.p.dtype))[0])
    body = float(bem.body_drag(s.body, jnp.zeros(3))[0])
    mass = float(bem.vehicle.mass)
    return -total / mass, -(total - body) / mass


@eqx.filter_jit
def _init(bem: BemQuadrotor, x: State) -> BemState:
    return bem.init(x)


@eqx.filter_jit
def _force(bem: BemQuadrotor, s: BemState, effects: ExternalEffects) -> Float[Array, "3"]:
    blades, _ = bem.rotors(s.body, s.body.motors, s.inflow, jnp.zeros_like(s.body.x.p))
    return bem.loads(s.body, s.body.motors, blades, effects).force


def inflow_panel() -> Panel:
    """Plot the induced velocity against the descent speed, with and without the vortex-ring rule."""
    descents = np.linspace(-6.0, 14.0, 81)
    ring_values, plain = list[float](), list[float]()
    for v in descents:
        _, inflow = steady_rotor(five_inch(), jnp.array(1109.15), jnp.array(0.0), jnp.array(float(v)))
        ring_values.append(float(vortex_ring(inflow, jnp.array(float(v)))))
        plain.append(float(inflow.v_i))
    spec = np.array([[-4, 5.3631], [-2, 6.5346], [-1, 7.1522], [0, 7.7904], [1, 8.7662], [2, 9.5403], [4, 10.9296]])
    return Panel(
        "Induced velocity, kingfisher's rotor at hover speed",
        "descent [m/s]",
        "induced velocity [m/s]",
        [
            Curve(descents, np.array(ring_values), "with the vortex-ring rule"),
            Curve(descents, np.array(plain), "momentum theory alone", dashed=True),
            Curve(spec[:, 0], spec[:, 1], "fine quadrature, bracketing search", marks=True, color=2),
        ],
    )


def rate_panel() -> Panel:
    """Plot the roll-rate and yaw-rate responses to a command step."""
    curves = list[Curve]()
    for name in QUADROTORS:
        bem = BemQuadrotor.of(VEHICLES[name](), DT)
        for axis, word in ((0, "roll"), (2, "yaw")):
            u = Command(jnp.array(STANDARD_GRAVITY), 2.0 * jnp.eye(3)[axis])
            rates = np.asarray(_fly_open_loop(bem, u, 300).omega)[:, axis]
            curves.append(
                Curve(np.arange(1.0, 301.0), rates / 2.0, f"{name}, {word}", dashed=axis == 2, color=len(curves) // 2)
            )
    return Panel("Step of the body rate", "time [ms]", "rate / command", curves, columns=2)


def step_panel() -> Panel:
    """Plot the acceleration response to a step in collective thrust."""
    curves = []
    for name in QUADROTORS:
        bem = BemQuadrotor.of(VEHICLES[name](), DT)
        u = Command(jnp.array(STANDARD_GRAVITY + 5.0), jnp.zeros(3))
        speeds = np.asarray(_fly_open_loop(bem, u, 300).x.v)[:, 2]
        curves.append(Curve(np.arange(2.0, 301.0), np.diff(speeds) / SUBSTEP, name))
    curves.append(Curve(np.array([0.0, 300.0]), np.array([5.0, 5.0]), "commanded", dashed=True))
    return Panel("Step of collective thrust by 5 m/s²", "time [ms]", "vertical acceleration [m/s²]", curves)


def sag_panel() -> Panel:
    """Plot the vertical acceleration under the hover command while the battery sags."""
    bem, sag, times = BemQuadrotor.of(VEHICLES["small"](), DT), disturbance("battery"), np.linspace(0.0, 120.0, 61)
    x = State.at(jnp.zeros(3))
    result = []
    for t in times:
        force = _force(bem, _init(bem, x), sag(jnp.array(float(t)), x))
        result.append(float(force[2] / bem.vehicle.mass) - STANDARD_GRAVITY)
    return Panel(
        "Battery sag: u_hover held still",
        "time [s]",
        "vertical acceleration [m/s²]",
        [Curve(times, np.array(result), "small, -0.2 %/s down to 80 %")],
    )


@eqx.filter_jit
def _fly_open_loop(bem: BemQuadrotor, u: Command, steps: int) -> RotorState:
    """Return the state after each millisecond, starting from hover."""
    effects = ExternalEffects.calm(jnp.zeros(3).dtype)

    def step(s: BemState, _: None) -> tuple[BemState, RotorState]:
        after = bem.substep(s, u, effects)
        return after, after.body

    return lax.scan(step, bem.init(State.at(jnp.zeros(3))), None, length=steps)[1]
