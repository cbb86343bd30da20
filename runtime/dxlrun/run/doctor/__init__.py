"""The doctor: what on this machine keeps a robot from running, or from running smoothly."""

from dxlrun.run.doctor.diagnosis import diagnose
from dxlrun.run.doctor.finding import Finding, State
from dxlrun.run.doctor.machine import Machine

__all__ = ["Finding", "Machine", "State", "diagnose"]
