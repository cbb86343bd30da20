"""The doctor: what on this machine keeps a robot from running, or from running smoothly."""

from dxlrun.doctor.diagnosis import diagnose
from dxlrun.doctor.finding import Finding, State
from dxlrun.doctor.machine import Machine

__all__ = ["Finding", "Machine", "State", "diagnose"]
