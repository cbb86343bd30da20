"""Phidget Spatial IMUs as sensors of dxlrun. Not tried on hardware.

Controllers that use their states are part of dxlrun: `imu_sensor_broadcaster`, `fall_reflex`.
"""

from dxlrun_phidget.spatial import PhidgetSpatial, PhidgetSpatialParameters

__all__ = ["PhidgetSpatial", "PhidgetSpatialParameters"]
