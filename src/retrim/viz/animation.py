"""Draws flights as an animated GIF: the vehicles in perspective, and their errors over time."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .plots import INK, PUSH, Span
from .sheet import sheet

if TYPE_CHECKING:
    import matplotlib.figure
    from matplotlib.axes import Axes

VIEW, TILT = np.radians(35.0), np.radians(18.0)  # azimuth and elevation of the camera
DISTANCE = 6.0  # [m], from the camera to the target
HALF, BELOW, ABOVE = 1.35, 1.6, 1.0  # [m], edges of a scene
ARM = 0.22  # [m], from the centre to a rotor; the vehicles are drawn larger than they are
DISC = 0.13  # [m], radius of a rotor
TRAIL_S, HOLD_S = 1.5, 1.5  # [s], lengths of the trail and of the last frame
ERROR_MAX = 2.0  # [m], top of the error axes
COLOURS = 96  # of each image
GROUND = 1.4  # [m], from the target to the ground
LINES = tuple(np.linspace(-1.5, 1.5, 7))  # [m], lines of the ground

_CIRCLE = np.stack([np.cos(a := np.linspace(0.0, 2.0 * np.pi, 17)), np.sin(a), 0.0 * a], 1)
_ROTORS = ARM * np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]]) / np.sqrt(2.0)


@dataclass(frozen=True)
class Actor:
    """One flight of an animation."""

    label: str
    colour: str
    t: np.ndarray
    """Times [s]."""
    p: np.ndarray
    """Positions relative to the target [m], rows x 3."""
    R: np.ndarray
    """Attitudes, body to world, rows x 3 x 3."""
    error: np.ndarray
    """Error in each row [m]."""
    crashed: bool = False


def project(points: np.ndarray) -> np.ndarray:
    """Return the image of points in a pinhole camera that looks at the origin.

    Args:
        points: Points in the world frame [m], ... x 3; those behind the camera become NaN.

    Returns:
        Right and up [m at the distance of the origin], ... x 2.
    """
    right = np.array([-np.sin(VIEW), np.cos(VIEW), 0.0])
    back = np.array([np.cos(VIEW) * np.cos(TILT), np.sin(VIEW) * np.cos(TILT), np.sin(TILT)])
    depth = DISTANCE - points @ back
    scale = np.where(depth > 0.1 * DISTANCE, DISTANCE / np.maximum(depth, 1e-9), np.nan)
    image: np.ndarray = np.stack([points @ right, points @ np.cross(back, right)], -1) * scale[..., None]
    return image


def animate(
    title: str, actors: Sequence[Actor], spans: Sequence[Span], *, rate: float = 12.5, width: int = 840
) -> bytes:
    """Return an animated GIF of several flights that run side by side in real time.

    Args:
        title: Title of the animation.
        actors: The flights.
        spans: Disturbances over time.
        rate: Frames per second.
        width: Width of the images [pixel].
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    end, frames = max(float(actor.t[-1]) for actor in actors), list[Image.Image]()
    with sheet((9.0, 5.0), 9.0) as figure:
        canvas: Any = FigureCanvasAgg(figure)  # matplotlib states no types for its methods
        stage = _Stage(figure, title, actors, spans, end)
        figure.set_dpi(width / 9.0)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # the layout of the first frame remains
        for t in np.arange(0.0, end + HOLD_S, 1.0 / rate):
            stage.draw(min(float(t), end))
            canvas.draw()
            image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
            frames.append(image.quantize(COLOURS, dither=Image.Dither.NONE))
    with io.BytesIO() as data:
        frames[0].save(
            data, "GIF", save_all=True, append_images=frames[1:], duration=round(1000.0 / rate), loop=0, optimize=True
        )
        return data.getvalue()


class _Stage:
    """The artists of an animation, which :meth:`draw` moves."""

    def __init__(
        self,
        figure: "matplotlib.figure.Figure",
        title: str,
        actors: Sequence[Actor],
        spans: Sequence[Span],
        end: float,
    ):
        self._actors, self._spans = actors, spans
        grid = figure.subplots(2, len(actors), height_ratios=(2.5, 1.0), squeeze=False, sharey="row")
        figure.suptitle(title, fontsize=11, fontweight="bold", color=INK)
        self._clock = figure.text(0.015, 0.9, "", va="top", color=INK, fontsize=9)
        self._scenes = [_Scene(axes, actor) for axes, actor in zip(grid[0], actors, strict=True)]
        self._curves = []
        for axes, actor in zip(grid[1], actors, strict=True):
            axes.set(xlim=(0.0, end), ylim=(0.0, ERROR_MAX), xlabel="time [s]")
            axes.grid(alpha=0.25)
            for span in spans:
                axes.axvspan(span.start, span.end, color=PUSH, alpha=0.2, linewidth=0)
            self._curves += axes.plot([], [], color=actor.colour, linewidth=1.6)
        grid[1][0].set_ylabel("error [m]")

    def draw(self, t: float) -> None:
        """Move everything to time t [s]."""
        label = next((span.label for span in self._spans if span.start <= t < span.end), "")
        self._clock.set_text(f"{t:.1f} s\n{label}")
        for actor, scene, curve in zip(self._actors, self._scenes, self._curves, strict=True):
            scene.draw(t)
            visible = actor.t <= t
            curve.set_data(actor.t[visible], actor.error[visible])


class _Scene:
    """One vehicle above the ground."""

    def __init__(self, axes: "Axes", actor: Actor):
        self._actor = actor
        axes.set(xlim=(-HALF, HALF), ylim=(-BELOW, ABOVE), xticks=[], yticks=[], aspect="equal")
        axes.spines[:].set_visible(False)
        axes.set_title(actor.label, fontsize=10, color=actor.colour)
        for x in LINES:
            for line in ([[x, LINES[0], 0.0], [x, LINES[-1], 0.0]], [[LINES[0], x, 0.0], [LINES[-1], x, 0.0]]):
                axes.plot(*project(np.array(line) - [0.0, 0.0, GROUND]).T, color="#DDDDDD", linewidth=0.7, zorder=0)
        axes.plot(0.0, 0.0, "+", color=INK, markersize=14, markeredgewidth=1.5, zorder=1)
        (self._shadow,) = axes.fill([0.0], [0.0], color="#BBBBBB", linewidth=0, zorder=1)
        (self._trail,) = axes.plot([], [], color=actor.colour, linewidth=1.2, alpha=0.5, zorder=2)
        self._arms = [axes.plot([], [], color=INK, linewidth=2.2, zorder=3)[0] for _ in range(2)]
        self._discs = [
            axes.fill([0.0], [0.0], color=actor.colour, alpha=0.75, linewidth=0, zorder=4)[0] for _ in _ROTORS
        ]
        self._note = axes.text(
            0.5, 0.06, "", transform=axes.transAxes, ha="center", color=actor.colour, fontsize=12, fontweight="bold"
        )

    def draw(self, t: float) -> None:
        """Move the vehicle to time t [s]."""
        actor = self._actor
        row = int(np.searchsorted(actor.t, t, side="right")) - 1
        p, rotors = actor.p[row], actor.p[row] + _ROTORS @ actor.R[row].T
        trail = (actor.t <= t) & (actor.t > t - TRAIL_S)
        self._trail.set_data(*project(actor.p[trail]).T)
        self._shadow.set_xy(project(0.8 * ARM * _CIRCLE + [p[0], p[1], -GROUND]))
        for arm, ends in zip(self._arms, (rotors[[0, 2]], rotors[[1, 3]]), strict=True):
            arm.set_data(*project(ends).T)
        for disc, centre in zip(self._discs, rotors, strict=True):
            disc.set_xy(project(centre + DISC * _CIRCLE @ actor.R[row].T))
        self._note.set_text("lost" if actor.crashed and t >= actor.t[-1] else "")
