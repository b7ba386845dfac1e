"""A real-time vehicle in a few lines: a point mass that takes off immediately and lands by itself."""

import time

import numpy as np

from live_processes import move
from retrim import PlantError
from retrim.plants.bridges.vehicle_plant import VehiclePlant
from retrim.plants.bridges.vehicle_state import VehicleState
from retrim.plants.entry import PlantEntry

HOVER = np.array([9.81, 0.0, 0.0, 0.0])


class PointVehicle(VehiclePlant):
    """A point mass at the origin under a push, with the faults ``faults``."""

    def __init__(self, request, *, push=(0.3, -0.2, 0.1), never_arms=False, lost_after=None, lands_in=0.0):
        super().__init__(request.dt, np.array([0.0, -6.0, -6.0, -2.0]), np.array([30.0, 6.0, 6.0, 2.0]))
        self.push, self.never_arms, self.lost_after = push, never_arms, lost_after
        self.lands_in = lands_in
        self.x, self.u, self.at, self.flying, self.reads = None, HOVER, 0.0, False, 0

    def connect(self, keep_on=lambda: True):
        if not keep_on():
            raise PlantError("given up")
        self.x = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)])

    def take_off(self, p, yaw, keep_on=lambda: True):
        if self.never_arms:
            raise PlantError("the autopilot refuses to be armed; it said: no battery")
        c, s = np.cos(yaw or 0.0), np.sin(yaw or 0.0)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self.x = np.concatenate([np.array([0.0, 0.0, 1.0]) if p is None else p, R.ravel(), np.zeros(3)])
        self.flying, self.at = True, time.monotonic()

    def hold(self, until):
        time.sleep(max(0.0, until - time.monotonic()))
        self.at, self.reads = time.monotonic(), 0

    def read(self):
        if self.x is None:
            raise PlantError("not connected")
        self.reads += 1
        if self.lost_after is not None and self.reads > self.lost_after:
            raise PlantError("the link has been silent")
        while self.flying and self.at < time.monotonic():
            self.x, self.at = move(self.x, self.u, self.push), self.at + 0.02
        R = self.x[3:12].reshape(3, 3)
        message = VehicleState(self.x[:3], R, self.x[12:], self.u[1:], 0.0)
        return message._replace(truth=message)

    def transmit(self, u):
        if not self.flying:
            raise PlantError("not flying")
        self.u = u
        return u

    def wait(self, until):
        time.sleep(max(0.0, until - time.monotonic()))

    def land(self):
        if self.flying:
            time.sleep(self.lands_in)
        self.flying, self.x = False, None


def entry(**faults):
    return PlantEntry(lambda request: PointVehicle(request, **faults), "a point mass under a push", is_vehicle=True)


point, unarmed, lost = entry(), entry(never_arms=True), entry(lost_after=40)
slow_to_land = entry(lands_in=2.6)
calm = entry(push=(0.0, 0.0, 0.0))
