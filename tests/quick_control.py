"""The control process of drills in which the supervisor hangs."""

from retrim.onboard import control_process


def fly(plan):
    """Fly, but wait less for the supervisor: if it is only late, the flight ends early, which these drills expect."""
    control_process.SUPERVISOR_TIMEOUT = 1.5
    control_process.fly(plan)
