"""Fly Betaflight's firmware with a simulated vehicle, pilot and motion capture, to try the link ``msp``.

``python -m retrim.testing.betaflight_peer`` starts the board, whose MSP port is ``tcp:127.0.0.1:5761``. The pilot
takes off and hovers. Motion capture publishes the pose over ROS 2 (``/mocap/quad``). Enter turns the pilot's switch of
the mode MSP OVERRIDE on or off; Ctrl-C ends the flight. With ``--log FILE``, the pilot flies by hand for half a minute,
with quick turns and changes of the throttle, and the board's Blackbox is written to the file. ``--set p_roll=90``
changes a setting of the board, for a vehicle with another rate controller.
"""

import argparse
import contextlib
import math
import os
import select
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ..config.scenario import Scenario
from ..errors import ConfigError, PlantError, exit_on_error
from ..onboard.guard import GeometricHover, Limits
from ..onboard.realtime import be_punctual
from ..physics.bem import BemQuadrotor
from ..physics.so3 import rotz
from ..physics.state import STANDARD_GRAVITY, State
from ..plants.bridges.betaflight_firmware import Firmware, find_firmware
from ..plants.bridges.betaflight_wire import HIGH, LOW, throttle_of
from ..plants.bridges.betaflight_world import World
from ..plants.plant import as_numpy
from ..ros2.backends import open_node
from ..ros2.message_type import message_type
from ..ros2.node import SENSOR, Ros2Node

DT = 0.01  # [s]
HOVER = np.array([STANDARD_GRAVITY, 0.0, 0.0, 0.0])
RECEIVER_S, ARMING_S, SPIN_UP_S = 2.0, 6.0, 0.4  # [s]: start of the receiver; arming; motors reach hover
ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
MASK = 0b1001111  # four sticks, and the channel of ANGLE
SETTINGS = [
    f"set msp_override_channels_mask = {MASK}",
    "set serial_update_rate_hz = 500",  # a board reads one packet in each run of its serial task
    "aux 1 50 1 1700 2100 0 0",  # MSP OVERRIDE on AUX2
    "aux 2 1 2 1700 2100 0 0",  # ANGLE on AUX3, which only the companion turns
]
LOGS = ["set blackbox_device = VIRTUAL", "set blackbox_sample_rate = 1/8"]
HIGH_ABOVE = (0.0, 0.0, 50.0)  # [m], where the pilot flies by hand
TURNS, TURN_S = np.array([1.5, 1.5, 1.0]), 0.1  # [rad/s], [s]: random rates and their memory
PUSHES, PUSH_S = 2.0, 0.4  # [m/s^2], [s]: random thrusts
LENGTHS_S = 5.0, 600.0  # [s], length of a flight by hand
LOG_END_S = 2.0  # [s] that the board needs for the end of its log


class BetaflightPeer:
    """A board, a vehicle and its pilot; :meth:`step` advances the pilot by 0.01 s."""

    def __init__(
        self,
        scenario: Scenario,
        place: np.ndarray,
        node: Ros2Node | None,
        topic: str,
        *,
        poses: bool = True,
        more: Sequence[str] = (),
    ) -> None:
        """Start the board, arm it, and hover.

        Args:
            scenario: Vehicle and disturbance; its plant is not used.
            place: Position at which the pilot hovers, world [m].
            node: Node through which motion capture publishes; None for no motion capture.
            topic: Topic of the state.
            poses: Whether poses are published, or odometry.
            more: Further settings of the board, ``NAME=VALUE``.

        Raises:
            PlantError: The firmware is not installed, does not start, or does not have such a setting.
        """
        vehicle = scenario.make_vehicle("small")
        model = BemQuadrotor.of(vehicle, 0.02, thrust_error=scenario.thrust_error)
        low, high = (as_numpy(u).astype(float) for u in (vehicle.command_min, vehicle.command_max))
        steps = math.ceil(math.degrees(1.05 * float(np.abs(high[1:]).max())) / 10.0)
        self._firmware = Firmware(find_firmware(), steps, [*SETTINGS, *LOGS, *(f"set {each}" for each in more)])
        self._limits = low, high
        self._esc, self._thrust_map, self._mass = vehicle.esc, float(model.loop.thrust_map), float(vehicle.mass)
        self.world = World(model, scenario.make_disturbance("small"), math.radians(10.0 * steps))
        fence = np.full(3, 1e3)
        self._pilot, self._place = GeometricHover(Limits(-fence, fence, low, high), DT), place
        self.override = False
        """Whether the pilot's switch of MSP OVERRIDE is on."""
        self._node, self._poses = node, poses
        self._kind = None if node is None else message_type(POSE if poses else ODOMETRY)
        self._publish = None if node is None or self._kind is None else node.advertise(topic, self._kind, SENSOR)
        self._arm()

    def step(self) -> None:
        """Move the pilot's sticks, and publish the state."""
        if not self._firmware.runs:
            raise PlantError("the firmware has ended")
        x = self.world.state()
        u = HOVER  # the board ignores the pilot's sticks under MSP OVERRIDE
        if self.override:
            self._pilot.integral[:] = 0.0
        else:
            u = self._pilot.command(np.concatenate([x.p, x.R.ravel(), x.v]), self._place)
        self.world.tell(self._throttle(float(u[0])), u[1:], switches=self._switches)
        if self._publish is not None and self._kind is not None:
            self._publish(self._kind.encode(self._message(x.p, x.R, x.v, x.omega)))

    def fly_by_hand(self, seconds: float) -> None:
        """Fly with random rates and thrusts around a place, as a pilot excites a vehicle for a log."""
        rng, turn, push = np.random.default_rng(0), np.zeros(3), 0.0
        turn_decay, push_decay = math.exp(-DT / TURN_S), math.exp(-DT / PUSH_S)
        began = due = time.monotonic()
        while due - began < seconds:
            x = self.world.state()
            turn = turn_decay * turn + math.sqrt(1.0 - turn_decay**2) * TURNS * rng.normal(size=3)
            push = push_decay * push + math.sqrt(1.0 - push_decay**2) * PUSHES * rng.normal()
            a = np.array([0.0, 0.0, STANDARD_GRAVITY]) - (x.p - self._place) - 1.5 * x.v
            level = 4.0 * x.R.T @ np.cross(x.R[:, 2], a / np.linalg.norm(a)) * np.array([1.0, 1.0, 0.0])
            u = np.clip(np.array([a @ x.R[:, 2] + push, *(turn + level)]), *self._limits)
            self.world.tell(self._throttle(float(u[0])), u[1:], switches=self._switches)
            due = max(due + DT, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))

    def write_log(self, path: Path) -> None:
        """Disarm, and write the board's Blackbox to a file.

        Raises:
            PlantError: The board has written no log.
        """
        self.world.tell(0.0, np.zeros(3), armed=False)
        time.sleep(LOG_END_S)
        logs = sorted(self._firmware.folder.glob("LOG*"))
        if not logs:
            raise PlantError("the board has written no log")
        path.write_bytes(logs[-1].read_bytes())

    @property
    def position(self) -> str:
        """Height and tilt of the vehicle."""
        x = self.world.state()
        tilt = math.degrees(math.acos(float(np.clip(x.R[2, 2], -1.0, 1.0))))
        return f"height {x.p[2]:.2f} m, tilt {tilt:.1f} deg"

    def close(self) -> None:
        """End the world and the board."""
        self.world.close()
        self._firmware.stop()

    @property
    def _switches(self) -> tuple[int, ...]:
        return (HIGH if self.override else LOW,)

    def _arm(self) -> None:
        world = self.world
        time.sleep(RECEIVER_S)
        world.tell(0.0, np.zeros(3), armed=True, switches=self._switches)
        until = time.monotonic() + ARMING_S
        while world.motors.min() <= 0.0:
            if time.monotonic() > until:
                self.close()
                raise PlantError(f"the firmware does not arm within {ARMING_S:g} s")
            time.sleep(0.02)
        world.place(State(jnp.asarray(self._place, float), rotz(jnp.asarray(0.0)), jnp.zeros(3)))
        world.tell(self._throttle(STANDARD_GRAVITY), np.zeros(3), switches=self._switches)
        time.sleep(SPIN_UP_S)
        world.release()

    def _throttle(self, c: float) -> float:
        speed = math.sqrt(max(0.0, c) * self._mass / (4.0 * self._thrust_map))
        return max(1e-3, throttle_of(float(self._esc.throttle(jnp.asarray(speed)))))

    def _message(self, p: np.ndarray, R: np.ndarray, v: np.ndarray, omega: np.ndarray) -> object:
        from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

        assert self._kind is not None
        message = self._kind.new()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
        message.header.frame_id = "map"
        pose = message.pose if self._poses else message.pose.pose
        pose.position.x, pose.position.y, pose.position.z = map(float, p)
        q = Rotation.from_matrix(R).as_quat()
        pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = map(float, q)
        if not self._poses:
            message.child_frame_id = "base_link"
            twist, velocity = message.twist.twist, R.T @ v
            twist.linear.x, twist.linear.y, twist.linear.z = map(float, velocity)
            twist.angular.x, twist.angular.y, twist.angular.z = map(float, omega)
        return message


def parse(words: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the options of the peer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicle", default="", help="vehicle file; by default the vehicle `small`")
    parser.add_argument("--disturbance", default="none", help="as for `retrim fly`")
    parser.add_argument("--place", type=float, nargs=3, default=(0.0, 0.0, 1.0), help="where the pilot hovers [m]")
    parser.add_argument("--topic", default="/mocap/quad", help="topic of the state")
    parser.add_argument("--odometry", action="store_true", help="odometry in place of poses")
    parser.add_argument("--log", default="", help="fly by hand, and write the board's Blackbox to this file")
    parser.add_argument("--seconds", type=float, default=30.0, help="length of the flight by hand")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of the board; repeatable"
    )
    parser.add_argument("--backend", default="", help="rclpy, cyclonedds or zenoh; by default, what is installed")
    return parser.parse_args(words)


@exit_on_error
def main(words: Sequence[str] | None = None) -> None:
    """Fly until Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    options = parse(words)
    scenario = Scenario(options.disturbance, vehicle=options.vehicle or None)
    if options.log:
        write_manual_log(scenario, options)
        return
    place, poses = np.array(options.place), not options.odometry
    with contextlib.closing(open_node(options.backend, ("geometry_msgs", "nav_msgs", "std_msgs"))) as node:
        peer = BetaflightPeer(scenario, place, node, options.topic, poses=poses, more=options.set)
        print("the pilot hovers; MSP at tcp:127.0.0.1:5761; Enter turns the switch of MSP OVERRIDE", flush=True)
        with contextlib.closing(peer), contextlib.suppress(KeyboardInterrupt):
            fly(peer)
        print(peer.position, flush=True)


def write_manual_log(scenario: Scenario, options: argparse.Namespace) -> None:
    """Fly by hand, and write the log."""
    if not LENGTHS_S[0] <= options.seconds <= LENGTHS_S[1]:
        raise ConfigError(f"--seconds must be {LENGTHS_S[0]:g} to {LENGTHS_S[1]:g}, got {options.seconds:g}")
    path = Path(options.log)
    if not path.parent.is_dir() or path.is_dir():
        raise ConfigError(f"--log must be a file in a folder that exists, got {options.log}")
    peer = BetaflightPeer(scenario, np.array(HIGH_ABOVE), None, "", more=options.set)
    with contextlib.closing(peer):
        peer.fly_by_hand(options.seconds)
        peer.write_log(path)
    print(f"{options.log}: {options.seconds:g} s of flight", flush=True)


def fly(peer: BetaflightPeer) -> None:
    """Step the pilot until Ctrl-C; each line of the input turns the switch."""
    be_punctual(25, os.sched_getaffinity(0))
    due, inputs = time.monotonic(), [sys.stdin.fileno()]
    while True:
        due = max(due + DT, time.monotonic())
        peer.step()
        ready = select.select(inputs, [], [], max(0.0, due - time.monotonic()))[0]
        if ready and not os.read(sys.stdin.fileno(), 64):
            inputs = []
        elif ready:
            peer.override = not peer.override
            print(f"MSP OVERRIDE {'on' if peer.override else 'off'}", flush=True)
        time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main()
