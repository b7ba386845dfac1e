"""Panel of the page; it contains controls and the status of the flight."""

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .manual_disturbance import LOAD, PUSH, WEAKEST, WIND, ManualDisturbance

HISTORY_S = 60.0  # [s]
START_S = 2.5  # [s], flight to the goal
LEAST = 0.5  # [cm], smallest top of the scale
KICKS = {"+x": (8.0, 0.0, 0.0), "-x": (-8.0, 0.0, 0.0), "+y": (0.0, 8.0, 0.0), "-y": (0.0, -8.0, 0.0)}  # [m/s^2]
WAITING_TEXT = "Waiting for take-off."


class Panel:
    """Panel with sliders, buttons and a history plot. It reports each user action immediately."""

    def __init__(
        self,
        server: Any,
        turn: Callable[[Callable[[ManualDisturbance], ManualDisturbance]], ManualDisturbance | None],
        wish: Callable[..., Mapping[str, Any]],
        knobs: ManualDisturbance,
        wishes: dict[str, Any],
        methods: tuple[str, ...],
        references: tuple[str, ...],
        mass: float,
        rate: float,
        world: str,
    ) -> None:
        """Build the panel.

        Args:
            server: The viser server.
            turn: Function that takes a mapping from the current positions of the knobs to the new ones; it returns
                the current positions if the new ones are not possible, else None.
            wish: Function that takes ``method`` and ``paused``, ``reference``, or ``land``; it returns the current
                requests, which may differ from the arguments.
            knobs: Positions of the knobs.
            wishes: Earlier requests.
            methods: Available learning methods, the current one first; empty if the flight does not learn.
            references: Available references, the initial one first; empty if there is no choice.
            mass: Mass of the vehicle [kg].
            rate: Refresh rate of the panel [Hz].
            world: Description of the plant and the disturbance, in Markdown.
        """
        self._tell, self._wish, self._gui, self._pull = turn, wish, server.gui, np.zeros(3)
        self._setting, self._choices = False, dict[str, Any]()
        self._history: deque[tuple[float, float, float]] = deque(maxlen=round(HISTORY_S * rate))
        self._text = self._gui.add_markdown(WAITING_TEXT)
        self._plot = _history_plot(self._gui)
        self._gui.add_markdown(world)
        with self._gui.add_folder("Added to the scenario"):
            self._gui.add_markdown("Grab the vehicle with the mouse and pull, or set:")
            self._push = _vector(self._gui, "push [m/s²]", knobs.push, PUSH, 0.1)
            self._wind = _vector(self._gui, "wind [m/s]", knobs.wind, WIND, 0.5)
            most = float(f"{min(LOAD, 0.8 * mass):.2g}")
            self._load = self._gui.add_slider(
                "load [kg]", 0.0, most, step=most / 50, initial_value=min(knobs.load, most)
            )
            self._rotor = self._gui.add_slider(
                "rotor",
                WEAKEST,
                1.0,
                step=0.01,
                initial_value=knobs.rotor,
                hint="share of its thrust that the front-right rotor keeps",
            )
            kick = self._gui.add_button_group("kick", tuple(KICKS))
            calm = self._gui.add_button("Calm", hint="all knobs back to nothing")
        for knob in (self._push, self._wind, self._load, self._rotor):
            knob.on_update(lambda _: self._turn_knobs())
        kick.on_click(lambda event: self._turn_knobs(event.target.value))
        calm.on_click(lambda _: self._calm())
        with self._gui.add_folder("Learning"):
            if methods:
                self._choices = {
                    "method": self._gui.add_dropdown(
                        "method", (*methods, "none"), initial_value=wishes.get("method", methods[0])
                    ),
                    "paused": self._gui.add_checkbox("pause", initial_value=bool(wishes.get("paused"))),
                }
                for choice in self._choices.values():
                    choice.on_update(lambda _: self._choose("method", "paused"))
            else:
                self._gui.add_markdown("This flight does not learn.")
        if len(references) > 1:
            initial = wishes.get("reference", references[0])
            dropdown = self._choices["reference"] = self._gui.add_dropdown(
                "reference", references, initial_value=initial
            )
            dropdown.on_update(lambda _: self._choose("reference"))
        self._gui.add_button("Land", color="red").on_click(lambda _: wish(land=True))

    def pull(self, a: np.ndarray) -> None:
        """Set the acceleration of the mouse pull in the world frame [m/s^2]."""
        self._pull = a
        self._turn_knobs()

    def note(self, t: float, error: float, policies: int) -> None:
        """Add the flight time [s], the distance from the target [m] and the number of policies to the history."""
        self._history.append((t, 100.0 * error, policies))

    def show(self, text: str) -> None:
        """Refresh the history plot and the status text, which is in Markdown."""
        self._text.content = text
        if len(self._history) > 1:
            t, error, policies = np.array(self._history).T
            top = top_of(t, error)
            marks = np.where(np.append(False, np.diff(policies) > 0), error, -10.0 * top)  # hide others below the axis
            self._plot.scales = _scales((t[0], t[-1]), top)
            self._plot.data = (t, error, marks)

    def _choose(self, *names: str) -> None:
        """Publish the values of some controls as requests, and set the controls to the resulting requests."""
        if self._setting:
            return
        before = {name: self._choices[name].value for name in names}
        new_wish = self._wish(**before)
        self._set(*((self._choices[name], new_wish[name]) for name in names))

    def _set(self, *values: tuple[Any, Any]) -> None:
        """Set the values of controls without reporting them as user actions."""
        self._setting = True
        try:
            for control, value in values:
                control.value = value
        finally:
            self._setting = False

    def _turn_knobs(self, kick: str | None = None) -> None:
        if self._setting:
            return

        def turn(before: ManualDisturbance) -> ManualDisturbance:
            push = np.clip(np.asarray(self._push.value, dtype=float) + self._pull, -PUSH, PUSH)
            return ManualDisturbance(
                (float(push[0]), float(push[1]), float(push[2])),
                self._wind.value,
                self._load.value,
                self._rotor.value,
                before.kick if kick is None else KICKS[kick],
                before.kicks + (kick is not None),
            )

        if (stand := self._tell(turn)) is not None:
            load = min(stand.load, self._load.max)
            self._set(
                (self._push, stand.push), (self._wind, stand.wind), (self._load, load), (self._rotor, stand.rotor)
            )

    def _calm(self) -> None:
        still = (0.0, 0.0, 0.0)
        self._set((self._push, still), (self._wind, still), (self._load, 0.0), (self._rotor, 1.0))
        self._tell(lambda before: ManualDisturbance(kick=before.kick, kicks=before.kicks))


def _vector(gui: Any, name: str, value: tuple[float, float, float], bound: float, step: float) -> Any:
    return gui.add_vector3(name, value, min=(-bound,) * 3, max=(bound,) * 3, step=step)


def _history_plot(gui: Any) -> Any:
    from viser import uplot

    nothing = np.array([0.0, 1.0])
    points = uplot.Series_Points(show=True, size=5, fill="#d64541")
    return gui.add_uplot(
        (nothing, nothing, nothing),
        (
            uplot.Series(label="t [s]"),
            uplot.Series(label="error [cm]", stroke="#3070d6", width=1.5),
            uplot.Series(label="new policy", stroke="#d64541", width=0, points=points),
        ),
        scales=_scales((0.0, 1.0), 1.0),
        aspect=2.3,
    )


def top_of(t: np.ndarray, error: np.ndarray) -> float:
    """Return the top of the history's scale [cm], which leaves out the flight to the goal once that is over.

    Args:
        t: Flight times [s].
        error: Distances from the target [cm].
    """
    after = error[t >= START_S]
    return max(LEAST, 1.1 * float((after if t[-1] >= 2.0 * START_S else error).max()))


def _scales(span: tuple[float, float], top: float) -> dict[str, Any]:
    """Return the ranges of the axes."""
    from viser import uplot

    return {
        "x": uplot.Scale(time=False, auto=False, range=(float(span[0]), float(span[1]))),
        "y": uplot.Scale(auto=False, range=(0.0, float(top))),
    }
