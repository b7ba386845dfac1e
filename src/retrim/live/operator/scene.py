"""Three-dimensional scene with the vehicle and the disturbances that act on it."""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

RED, BLUE, GREY, GREEN, DARK = (214, 69, 65), (48, 112, 214), (150, 150, 150), (60, 160, 90), (45, 45, 50)
METRES = 0.1  # [m per m/s^2], length of arrows
ZENITH, HORIZON, GROUND = (176, 203, 232), (238, 243, 248), (222, 227, 224)
LEAST_DISTANCE, ARMS = 0.7, 6.0  # camera distance [m], and in arms of the vehicle, plus the size of the reference
ROPE = 5.0  # [1/s^2], acceleration per metre between grip and hand
TRAIL_S = 6.0  # [s]
FORWARD = np.array([[1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, 1.0]])
"""Directions of the rotors (front-right, back-left, back-right, front-left); x points forward, y to the left."""


class Scene:
    """Vehicle, trail, reference and arrows. Each object is sent to the browser once and then moved."""

    def __init__(self, server: Any, path: np.ndarray, arm: float, rate: float) -> None:
        """Build the scene.

        Args:
            server: The viser server.
            path: Positions along the reference, world [m], (n, 3).
            arm: Distance from the centre of the vehicle to a rotor [m].
            rate: Update rate of the scene [Hz].
        """
        # With software rendering, the page appears in a sixth of the time without shadows.
        server.scene.configure_default_lights(cast_shadow=False)
        self._scene, self._trail = server.scene, deque[np.ndarray](maxlen=round(TRAIL_S * rate))
        middle, size = path.mean(0), float(np.ptp(path, axis=0).max())
        distance = max(LEAST_DISTANCE, ARMS * arm) + size
        server.initial_camera.position = tuple(middle + distance * np.array([-0.8, -0.7, 0.35]))
        server.initial_camera.look_at = tuple(middle - distance * np.array([0.0, 0.0, 0.25]))  # shows the ground, too
        _world(self._scene, middle, 2.0 * np.ceil(3.0 + size))
        if size > 0.01:
            self.follow(path)
        self._target = self._scene.add_icosphere("/target", 0.03, GREEN, opacity=0.6, cast_shadow=False)
        self._scene.add_label("/target/name", "target", position=(0.0, 0.0, 0.05), font_screen_scale=0.8)
        self._shadow = self._scene.add_cylinder(
            "/shadow", radius=1.2 * max(arm, 0.08), height=0.002, color=GREY, opacity=0.4
        )
        self._vehicle = self._scene.add_frame("/vehicle", show_axes=False)
        _quadrotor(self._scene, max(arm, 0.08))
        self._grip = self._scene.add_icosphere(
            "/vehicle/grip", 1.7 * max(arm, 0.08), GREEN, opacity=0.06, cast_shadow=False
        )
        self._rope = self._scene.add_line_segments("/rope", np.zeros((1, 2, 3)), GREEN, thickness=0.01, visible=False)
        self._line = self._scene.add_line_segments("/trail", np.zeros((1, 2, 3)), DARK, thickness=0.008)
        self._arrows = {
            name: self._scene.add_arrows(
                f"/{name}", np.zeros((1, 2, 3)), color, shaft_radius=0.008, head_radius=0.02, head_length=0.05
            )
            for name, color in (("disturbance", RED), ("estimate", BLUE))
        }

    def on_pull(self, pull: Callable[[np.ndarray], None]) -> None:
        """Call ``pull`` with an acceleration while the user pulls the vehicle, and with zero when the pull ends.

        Args:
            pull: Function that takes the acceleration, world [m/s^2].
        """

        async def drag(event: Any) -> None:  # the server preserves the order of calls for coroutines only
            grip, hand = (np.asarray(place, dtype=float) for place in (event.start_position, event.end_position))
            over = event.phase == "end" or grip.shape != (3,) or hand.shape != (3,)
            if over or not np.isfinite([grip, hand]).all():  # an invalid browser message must end a pull, too
                self._rope.visible = False
                pull(np.zeros(3))
                return
            self._rope.visible, self._rope.points = True, np.stack([grip, hand])[None]
            pull(ROPE * (hand - grip))

        self._grip.on_drag("left")(drag)

    def follow(self, path: np.ndarray) -> None:
        """Show the current reference, given positions along it in the world frame [m], (n, 3)."""
        pairs = np.stack([path[:-1], path[1:]], axis=1)
        self._scene.add_line_segments("/reference", pairs, GREY, thickness=0.006)

    def move(
        self, p: np.ndarray, R: np.ndarray, target: np.ndarray, disturbance: np.ndarray, estimate: np.ndarray
    ) -> None:
        """Show a new state.

        Args:
            p: Position, world [m].
            R: Attitude, from body to world.
            target: Target position, world [m].
            disturbance: Acceleration that the simple model does not describe, world [m/s^2].
            estimate: Estimate of this acceleration from the residual model, world [m/s^2].
        """
        self._vehicle.position, self._vehicle.wxyz = tuple(p), quaternion(R)
        self._shadow.position = (p[0], p[1], 0.0)  # vertically below the vehicle, to make its height visible
        self._target.position = tuple(target)
        self._trail.append(p)
        if len(self._trail) > 1:
            points = np.stack(self._trail)
            self._line.points = np.stack([points[:-1], points[1:]], axis=1)
        for (name, arrow), a in zip(self._arrows.items(), (disturbance, estimate), strict=True):
            above = 0.04 if name == "estimate" else 0.0  # an offset, so that equal arrows do not overlap
            start = p + np.array([0.0, 0.0, above])
            arrow.visible = bool(np.linalg.norm(a) > 0.05)
            arrow.points = np.stack([start, start + METRES * a])[None]


def quaternion(R: np.ndarray) -> tuple[float, float, float, float]:
    """Return an attitude as a unit quaternion, real part first."""
    from scipy.spatial.transform import Rotation  # local import, because it takes as long as the import of retrim

    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return float(w), float(x), float(y), float(z)


def _world(scene: Any, middle: np.ndarray, size: float) -> None:
    """Add a sky, the ground with a grid of half metres, and the world axes below the reference."""
    share = np.linspace(0.0, 1.0, 64)[:, None, None]
    sky = (1.0 - share) * np.array(ZENITH) + share * np.array(HORIZON)
    scene.set_background_image(np.broadcast_to(sky, (64, 2, 3)).astype(np.uint8), format="png")
    scene.add_grid(
        "/ground", width=size, height=size, position=(middle[0], middle[1], 0.0), plane_color=GROUND, plane_opacity=0.8,
        infinite_grid=True, fade_distance=2.0 * size,
    )  # fmt: skip
    scene.add_frame("/axes", axes_length=0.3, axes_radius=0.008, position=(middle[0], middle[1], 0.0))
    for name, place in zip("xyz", 0.35 * np.eye(3), strict=True):
        scene.add_label(f"/axes/{name}", name, position=tuple(place), font_screen_scale=0.8)


def _quadrotor(scene: Any, arm: float) -> None:
    across = arm / 2.0**0.5
    scene.add_box("/vehicle/body", DARK, dimensions=(0.7 * arm, 0.45 * arm, 0.25 * arm))
    scene.add_box("/vehicle/nose", RED, dimensions=(0.12 * arm, 0.3 * arm, 0.2 * arm), position=(0.4 * arm, 0.0, 0.0))
    for i, (x, y) in enumerate(across * FORWARD):
        name, color = f"/vehicle/rotor{i}", RED if x > 0 else GREY
        # Opaque, since the transparent grip around the vehicle would hide transparent rotors.
        scene.add_cylinder(name, radius=0.55 * arm, height=0.04 * arm, color=color, position=(x, y, 0.2 * arm))
        ends = np.array([[[0.0, 0.0, 0.0], [x, y, 0.0]], [[x, y, 0.0], [x, y, 0.2 * arm]]])
        scene.add_line_segments(f"/vehicle/arm{i}", ends, DARK, thickness=0.12 * arm)
