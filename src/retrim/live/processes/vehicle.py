"""Process of the link to a vehicle; the process transfers samples and commands in real time."""

import math
import signal
import sys
import time
from types import FrameType

import numpy as np

from ...errors import PlantError
from ...onboard.guard import HOVER, Limits
from ...onboard.messages import Sample, last_note, pack_note
from ...onboard.realtime import ParentWatch, be_punctual
from ...onboard.tick_budget import SHARE
from ...plants.bridges.frames import heading_of
from ...plants.bridges.vehicle_plant import VehiclePlant
from ...plants.bridges.vehicle_state import VehicleState
from ...transport.bus import Bus
from ...transport.shared_memory import SharedMemoryBus
from .plant import SUPERVISOR_TIMEOUT, PlantPlan, answer

HOLD_S = 0.05  # [s] between two reads of the orders while the autopilot holds the vehicle


def fly(plan: PlantPlan) -> None:
    """Take off, transfer messages until landing, and return control to the autopilot; main function of the process."""
    signal.signal(signal.SIGTERM, _stop_on_signal)  # return control to the autopilot in this case, too
    bus, parent = SharedMemoryBus(plan.folder), ParentWatch(plan.parent)

    def is_active() -> bool:
        return not parent.has_ended() and last_note(bus, "order").get("order") != "land"

    try:
        with plan.scenario.make(plan.vehicle, dt=plan.dt, seed=plan.seed) as plant:
            if not isinstance(plant, VehiclePlant):
                raise PlantError(f"plant {plan.scenario.plant!r} is not a VehiclePlant")
            refusals = be_punctual(plan.priority, set(plan.cores))  # the threads of the link inherit the priority
            plant.connect(is_active)
            bus.publish("ready.plant", pack_note("ready", refused=refusals, stands=True))
            while last_note(bus, "order").get("order") != "take off":
                if not is_active():
                    return
                plant.wait(time.monotonic() + HOLD_S)

            def keep_on(link: VehiclePlant = plant) -> bool:
                if link.waits_for != last_note(bus, "world").get("waits_for", ""):
                    bus.publish("world", pack_note("world", waits_for=link.waits_for))
                return is_active()

            plant.take_off(plan.x0[:3], heading_of(plan.x0[3:12].reshape(3, 3)), keep_on)
            plant.now()  # performs the imports of the first call before timing matters
            bus.publish("airborne", pack_note("airborne"))
            while (epoch := last_note(bus, "order").get("epoch")) is None:
                if not is_active():
                    return
                plant.hold(time.monotonic() + HOLD_S)
            plant.hold(float(epoch))
            reason = _carry(plan, plant, bus, parent, float(epoch))
    except PlantError as error:
        reason = f"plant lost: {error}"
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the link is already closed
    bus.publish("ended", pack_note("ended", reason=reason))


def _carry(plan: PlantPlan, plant: VehiclePlant, bus: Bus, parent: ParentWatch, epoch: float) -> str:
    """Transfer samples and commands; return the reason for the end of the flight."""
    tick, late, holds, silent_ticks = 0, 0, 0, 0
    accepted_u = HOVER
    while True:
        plant.wait(epoch + tick * plan.dt)
        now = plant.now()
        bus.publish("sample", _sample(tick, plan.dt, now, accepted_u).pack())
        setpoint = answer(bus, tick, epoch + (tick + SHARE) * plan.dt)
        silent_ticks = 0 if setpoint is not None else silent_ticks + 1
        if setpoint is None:
            holds += 1  # without a new command the autopilot keeps the last one for as long as it permits
            if silent_ticks * plan.dt > SUPERVISOR_TIMEOUT and parent.has_ended():
                return "no commands arrive, and the supervisor is gone"
        elif setpoint.is_final:
            return setpoint.ending(float(now.p[2]))
        else:
            accepted_u = plant.send(setpoint.u)
        due = math.ceil((time.monotonic() - epoch) / plan.dt)
        late += max(0, due - tick - 1)
        tick = max(tick + 1, due)
        if tick % 25 == 0:
            refusal = "a vehicle has no knobs" if bus.latest("knobs") is not None else ""
            bus.publish("world", pack_note(
                "world", late=late, held=holds, lost=plant.lost_time, knobs_refused=refusal, notes=list(plant.notes)
            ))  # fmt: skip


def _sample(tick: int, dt: float, now: VehicleState, accepted_u: np.ndarray) -> Sample:
    state, truth = (np.concatenate([x.p, x.R.ravel(), x.v]) for x in (now, now.truth or now))
    # Normally report the age after extrapolation, for which the controller compensates. If the measurement is too old
    # for the guard, report its full age: the guard then refuses the measurement.
    age = now.age if now.news <= Limits.state_age else now.news
    return Sample(tick, tick * dt, time.monotonic(), age, state, truth, accepted_u)


def _stop_on_signal(number: int, frame: FrameType | None) -> None:
    sys.exit(128 + number)
