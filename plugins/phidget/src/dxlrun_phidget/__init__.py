"""Phidget Spatial IMUs as sensors of dxlrun. Not tried on hardware."""

from dxlrun_phidget.spatial import PhidgetSpatial, PhidgetSpatialParameters

__all__ = ["PhidgetSpatial", "PhidgetSpatialParameters"]
