"""Run PX4 with a simulated vehicle and simulated motion capture on this machine, for flights without a vehicle.

``python -m retrim.testing.px4 PACKAGE`` runs them until Ctrl-C. PACKAGE is a folder with ``bin/px4`` and ``etc``. The
vehicle is that of PX4's own simulation, whose inertial unit is noisy. With ``--vehicle FILE``, PX4's firmware flies a
vehicle of this project, with blade-element rotors and the sensors of a usual autopilot; with ``--disturbance large``,
Enter begins a push. ``--set MC_ROLLRATE_P=0.08`` sets a parameter, for a vehicle with another rate controller. PX4
listens on every address of the machine; a network namespace can isolate it.
"""

import argparse
import contextlib
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from ..config.scenario import Scenario
from ..config.vehicles import vehicle_from
from ..errors import ConfigError, PlantError, exit_on_error
from ..onboard.realtime import be_punctual
from ..plants.bridges.endpoint import UdpEndpoint
from ..plants.bridges.mavlink_link import MavlinkLink
from .px4_world import STEP, Px4World, parameters_of

GROUND_STATION = 14550  # port to which PX4 sends, in addition to the port for a companion computer
PAYLOAD = 14030  # a further port to which PX4 sends
OWN_MODEL, EXTERNAL = "sihsim_quadx", "none_iris"
"""PX4's models of vehicles: with its own physics, and with the physics of another program."""
CAPTURE_RATE = 50.0  # [Hz]: rate of the motion capture
MOCAP = {
    "EKF2_EV_CTRL": 15, "EKF2_HGT_REF": 3, "EKF2_GPS_CTRL": 0, "EKF2_BARO_CTRL": 0, "EKF2_RNG_CTRL": 0,
    "EKF2_EV_NOISE_MD": 1, "EKF2_EVP_NOISE": 0.01, "EKF2_EVV_NOISE": 0.02, "EKF2_EVA_NOISE": 0.05,
    "EKF2_EV_DELAY": 8, "EKF2_DELAY_MAX": 20, "EKF2_TAU_POS": 0.1, "EKF2_TAU_VEL": 0.1,
}  # fmt: skip
"""PX4 parameters that select motion capture instead of GPS and barometer, and its delay and precision.

With PX4's defaults for the delay (200 ms) and for the filters of the output (0.25 s), the estimated position is 0.2 s
late.
"""
START_S, SLIP_S = 10.0, 0.05  # [s]: start of PX4; lost time that is reported
READY_TEXT = "PX4 flies at udp:127.0.0.1:14540; Ctrl-C ends it"
TIMING = {"IMU_INTEG_RATE": 400, "COM_OBL_RC_ACT": 5}
"""PX4 parameters for a state every 10 ms, and for position hold when setpoints stop."""


class Px4Simulation:
    """A PX4 process; leaving the context ends the process."""

    def __init__(self, package: Path, run: Path, *, model: str = OWN_MODEL, **parameters: float) -> None:
        """Prepare the simulation without starting PX4.

        Args:
            package: Folder with ``bin/px4`` and ``etc``.
            run: Empty folder for the files of the process.
            model: PX4's name of the simulated vehicle: the one with its own physics, or :data:`EXTERNAL`.
            parameters: PX4 parameters, in addition to those for motion capture.

        Raises:
            PlantError: The package does not contain PX4.
        """
        self._package, self._run, self._model = package.resolve(), run.resolve(), model
        self._parameters = MOCAP | TIMING | parameters
        if not (self._package / "bin/px4").exists():
            raise PlantError(f"{package}: there is no bin/px4 there")

    def __enter__(self) -> "Px4Simulation":
        """Start the process."""
        parameters = {f"PX4_PARAM_{name}": str(value) for name, value in self._parameters.items()}
        variables = {
            "PX4_SIM_MODEL": self._model,
            "PX4_SIMULATOR": "sihsim" if self._model == OWN_MODEL else "none",
            "PX4_PARAM_SDLOG_BACKEND": "0",
        }
        with (self._run / "px4.log").open("wb") as log:
            self._process = subprocess.Popen(
                [self._package / "bin/px4", "-d", "-s", "etc/init.d-posix/rcS", "-w", self._run, self._package / "etc"],
                cwd=self._run,
                env=os.environ | variables | parameters,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the process."""
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(3.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    @property
    def has_ended(self) -> bool:
        """Whether the process has ended by itself."""
        return self._process.poll() is not None


class MotionCapture:
    """A simulated motion capture system, which sends PX4 the true state of its vehicle."""

    def __init__(self, port: int = GROUND_STATION) -> None:
        """Listen on the port to which PX4 sends for ground stations."""
        self.link = MavlinkLink(UdpEndpoint("127.0.0.1", port))
        self._last_truth = self._last_request = 0.0

    def step(self, until: float) -> None:
        """Send states until a time on the monotonic clock [s]."""
        while time.monotonic() < until:
            self.link.pump(time.monotonic() + 2e-3)
            truth = self.link.truth
            if truth is not None and truth.stamp > self._last_truth:
                self._last_truth = truth.stamp
                self.link.see(truth)
            elif self.link.system is not None and time.monotonic() - max(self._last_request, self._last_truth) > 1.0:
                self._last_request = time.monotonic()
                self.link.stream("HIL_STATE_QUATERNION", CAPTURE_RATE)


def parameter(text: str) -> tuple[str, float]:
    """Return the name and the value of ``NAME=VALUE``."""
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be NAME=NUMBER, got {text!r}") from None


@exit_on_error
def main(words: Sequence[str] | None = None) -> None:
    """Run until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("package", type=Path, help="folder with bin/px4 and etc")
    parser.add_argument(
        "--set",
        type=parameter,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a parameter of PX4; repeatable",
    )
    parser.add_argument("--vehicle", help="a vehicle, or a vehicle file, in place of the one of PX4's simulation")
    parser.add_argument("--disturbance", help="with --vehicle: a disturbance that begins with Enter")
    options = parser.parse_args(words)
    if options.disturbance and not options.vehicle:
        raise ConfigError("--disturbance needs --vehicle; PX4's own simulation has no disturbances")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as run, contextlib.suppress(KeyboardInterrupt):
        fly = _fly_own if options.vehicle is None else _fly_external
        fly(options, Path(run))
        sys.exit(f"PX4 has ended: {(Path(run) / 'px4.log').read_text()[-500:]}")


def _fly_own(options: argparse.Namespace, run: Path) -> None:
    """Run PX4 with its own physics until it ends."""
    with Px4Simulation(options.package, run, **dict(options.set)) as px4:
        cameras = MotionCapture()
        print(READY_TEXT, flush=True)
        while not px4.has_ended:
            cameras.step(time.monotonic() + 0.5)


def _fly_external(options: argparse.Namespace, run: Path) -> None:
    """Run PX4 with a vehicle of this project until PX4 ends."""
    scenario = Scenario(options.disturbance or "none", vehicle=vehicle_from(options.vehicle))
    vehicle = scenario.make_vehicle("small")
    parameters = parameters_of(vehicle) | dict(options.set)
    disturbance = scenario.make_disturbance("small")
    with (
        contextlib.closing(Px4World(vehicle, disturbance)) as world,
        Px4Simulation(options.package, run, model=EXTERNAL, **parameters) as px4,
    ):
        world.connect()
        be_punctual(25, os.sched_getaffinity(0))
        cameras = MotionCapture()
        print(READY_TEXT, flush=True)
        every, second, starting = (round(interval / STEP) for interval in (1.0 / CAPTURE_RATE, 1.0, START_S))
        steps, slip, listens = 0, 0.0, options.disturbance is not None
        while not px4.has_ended:
            world.step()
            steps += 1
            if steps % second == 0:
                if steps > starting and world.slip - slip > SLIP_S:
                    print(f"the simulation lost {world.slip - slip:.2f} s in 1 s: the machine is busy", flush=True)
                slip = world.slip
            if steps % every == 0:
                cameras.link.pump(time.monotonic())
                cameras.link.see(world.capture())
                if listens and select.select([sys.stdin], [], [], 0.0)[0]:
                    listens = False
                    if sys.stdin.readline():
                        world.disturb()


if __name__ == "__main__":
    main()
