"""What a person sees of simulated servos while they run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dxlrun.simulation.bus.simulated_bus import SimulatedBus
from dxlrun.simulation.memory.cells import Memory
from dxlrun.simulation.servo.simulated_servo import SimulatedServo

_GOAL_MODES = (3, 4, 5)
"""Operating Mode (11): position, extended position, current-based position (e-Manual, X series)."""


def servo_looks(bus: SimulatedBus, now_ns: int) -> list[Mapping[str, object]]:
    """Return each servo of a bus as it is now: angles in rad from raw 0, degrees C, V."""
    bus.advance(now_ns)
    return [_look(bus, servo) for servo in bus.servos]


def _look(bus: SimulatedBus, servo: SimulatedServo) -> Mapping[str, object]:
    counts = bus.counts(servo)
    registers = servo.registers
    return {
        "bus": bus.name,
        "id": servo.servo_id,
        "model": registers.table.model,
        "torque": servo.torque_on,
        "goal": _goal(registers),
        "present": servo.position,
        "temperature": servo.temperature,
        "voltage": servo.voltage,
        "error": registers.get("hardware_error_status", counts.last_error),
        "heard": counts.heard,
        "answered": counts.answered,
    }


def _goal(registers: Memory) -> float | None:
    """Return the goal, rad from raw 0; None in a mode that has none."""
    if "goal_position" not in registers or registers.get("operating_mode", 3) not in _GOAL_MODES:
        return None
    if registers.get("cw_angle_limit", 1) == registers.get("ccw_angle_limit", 1) == 0:
        return None  # wheel mode (e-Manual, AX-12A, CW/CCW Angle Limit)
    return registers.ticks("goal_position") * registers.table.rad_per_tick


def lateness_us(buses: Sequence[SimulatedBus]) -> Mapping[str, float]:
    """Return how late hosts got their last bytes, us: median, p99, maximum; nothing before the first."""
    ordered = sorted(late_ns for bus in buses for late_ns in bus.lateness_ns)
    if not ordered:
        return {}
    picked = {
        "median": ordered[len(ordered) // 2],
        "p99": ordered[len(ordered) * 99 // 100],
        "maximum": ordered[-1],
    }
    return {name: late_ns / 1000 for name, late_ns in picked.items()}
