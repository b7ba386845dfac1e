"""Simulate a vehicle with ROS 2 and the plant ``bem``, for tests and trials of a node.

``python -m retrim.testing.ros2_peer mavros --disturbance large`` runs until Ctrl-C. With ``mavros``, the vehicle flies
to the start, follows attitude targets while it receives them, and holds its position when they stop. With ``px4``, it
stands on the ground, and behaves like PX4: it is armed by a command, follows setpoints in offboard mode, lands, and
holds its position when setpoints stop.
"""

import argparse
from collections.abc import Sequence

import numpy as np

from ..config.scenario import Scenario
from ..errors import exit_on_error
from ..ros2.backends import open_node
from ..ros2.definitions import NEWEST, RELEASES
from ..ros2.node import Ros2Node
from .peer_vehicle import fly_until_interrupt
from .ros2_mavros_peer import Habits, MavrosPeer, Ros2Peer
from .ros2_px4_peer import Px4Peer


def make_peer(node: Ros2Node, options: argparse.Namespace) -> Ros2Peer:
    """Return the peer that options describe."""
    scenario = Scenario(options.disturbance, options.plant)
    jump = None if options.clock_jump is None else tuple(options.clock_jump)
    habits = Habits(options.rate, scrambled=options.scrambled, jump=jump)
    if options.dialect == "px4":
        return Px4Peer(
            node, scenario, habits, release=options.release, reports_thrust=options.reports_thrust,
            answers=not options.silent, namespace=options.namespace or "",
        )  # fmt: skip
    return MavrosPeer(
        node, scenario, habits, place=np.array(options.place), yaw=options.yaw, poses=options.poses,
        reports_thrust=options.reports_thrust, namespace=options.namespace or "/mavros",
    )  # fmt: skip


def parse(words: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the options of a peer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dialect", choices=("mavros", "px4"), help="whose topics it has")
    parser.add_argument("--backend", default="", help="rclpy, cyclonedds or zenoh; by default, what is installed")
    parser.add_argument("--listen", default="", help="HOST:PORT at which it waits in place of a zenoh router")
    parser.add_argument("--disturbance", default="none", help="as for `retrim fly`")
    parser.add_argument("--plant", default="bem", help="as for `retrim fly`")
    parser.add_argument("--namespace", default="", help="prefix of the topics")
    parser.add_argument("--place", type=float, nargs=3, default=(0.0, 0.0, 1.0), help="mavros: where it waits [m]")
    parser.add_argument("--yaw", type=float, default=0.0, help="mavros: its heading there [rad]")
    parser.add_argument("--poses", action="store_true", help="mavros: poses alone, no odometry")
    parser.add_argument("--release", default=NEWEST, choices=RELEASES, help="px4: release of its messages")
    parser.add_argument("--silent", action="store_true", help="px4: no answers about the formats of its inputs")
    parser.add_argument("--reports-thrust", action="store_true", help="it publishes the autopilot's thrust")
    parser.add_argument("--rate", type=float, default=100.0, help="of its states [Hz]")
    parser.add_argument("--scrambled", action="store_true", help="every second state overtakes the one before it")
    parser.add_argument(
        "--clock-jump", type=float, nargs=2, help="seconds after the first setpoint at which its clock is set, and by"
    )
    return parser.parse_args(words)


@exit_on_error
def main(words: Sequence[str] | None = None) -> None:
    """Fly until Ctrl-C."""
    options = parse(words)
    packages = ("px4_msgs",) if options.dialect == "px4" else ("mavros_msgs", "nav_msgs", "geometry_msgs")
    if options.listen:
        from ..ros2.zenoh_node import ZenohNode

        node: Ros2Node = ZenohNode(options.listen, listen=True)
    else:
        node = open_node(options.backend, packages)
    fly(node, options)


def fly(node: Ros2Node, options: argparse.Namespace) -> None:
    """Fly a peer through a node until Ctrl-C."""
    peer = make_peer(node, options)
    fly_until_interrupt(peer.step, f"it is in ROS 2 by {node.backend}", peer.habits.period)
    node.close()


if __name__ == "__main__":
    main()
