"""Sensor: motion capture with few cameras. `retrim fly --sensors sensor:mocap`."""

import retrim


def mocap():
    """Return the sensor model: noise [m, m/s, rad], share of lost samples, latency [ms]."""
    return retrim.SensorModel.of(position=2e-3, velocity=10e-3, attitude=2e-3, dropout=0.02, latency=20)
