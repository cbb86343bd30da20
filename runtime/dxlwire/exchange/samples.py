"""Samples: converts the replies of a cycle to states of the whole robot in SI units, without implausible
jumps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from dxlwire.bus_plan import BusPlan, ServoPlan
from dxlwire.control_table import find_table
from dxlwire.exchange import reports
from dxlwire.exchange.arrays import Floats, JointArrays, SourceArrays
from dxlwire.exchange.device_samples import DeviceSamples
from dxlwire.exchange.reports import Reason, ReportSink
from dxlwire.modes import Mode

_WHEEL_MODES = (Mode.VELOCITY, Mode.PWM)

MARGIN_RAD = 0.035  # Two degrees: noise of a potentiometer, plus the movement by a hand [i]
MARGIN_NS = 10_000_000
"""Jitter of replies, ns: the time between two replies may appear shorter by this much."""
REPORT_AGAIN_NS = 1_000_000_000  # Minimum interval between two events of one servo


class Samples:
    """Newest values of all servos of a robot, and the conversion of replies to them; arrays have one column
    per servo, in the order of the plans.

    Position: q = direction * (raw * rad_per_tick - reference) * ratio, rad or m. The sign of velocity and
    effort follows the joint's direction, so positive effort is torque toward growing q. In wheel mode a
    model without speed control reports a fraction of full output as its speed (AX-12A, Present Speed
    (38)), see `mode_plan`."""

    def __init__(
        self,
        plans: Sequence[BusPlan],
        states: JointArrays,
        sources: SourceArrays,
        reports: ReportSink,
    ) -> None:
        servos = [servo for plan in plans for servo in plan.servos]
        self.states = states  # States of the robot; filled by this class
        self.rows = np.array([servo.row for servo in servos], dtype=np.intp)
        """Row of each servo's joint in the states."""
        self.values: Floats = np.full((3, len(servos)), np.nan)
        """Position, velocity and effort in each servo's newest intact reply, SI units, shape (3, servos)."""
        self.scale: Floats = np.array([_units(servo) for servo in servos]).reshape(-1, 3).T.copy()
        """SI units per tick of position, velocity and effort, shape (3, servos); that of the velocity
        follows the servo's mode."""
        self.reference: Floats = np.array([servo.zero for servo in servos])
        """Offset subtracted from each servo's position, rad or m."""
        self.fresh = np.zeros(len(servos), dtype=np.bool_)
        """True for each servo whose intact reply arrived in this cycle."""
        self.at_ns = np.full(len(servos), -1, dtype=np.int64)
        """Arrival time of each servo's newest plausible reply, ns; -1 before the first reply."""
        self.shown_ns = self.at_ns.copy()
        """Arrival time of the reply from which each servo's states come, ns: `at_ns` at the end of the
        cycle before."""
        self.recounted_ns = np.full(len(servos), -2, dtype=np.int64)
        """Time of the last sample before a servo restarted its turn count, ns; -2 if it never did."""
        self.doubted = np.zeros(len(servos), dtype=np.bool_)
        """True for each servo whose position of this cycle is rejected as an implausible jump."""
        self.jumps = Jumps(plans, reports)
        self.take: Callable[[int, int, bytes, int], object]
        """Store a reply; arguments: index of the bus, index of the member, data, arrival time in ns. Set
        by the kernel."""
        self.settle_all: Callable[[int], int]
        """Fill the states from the replies of this cycle; argument: time in ns. Returns 0, or another
        number if no state was filled because a value is suspect. Set by the kernel."""
        self.show: Callable[[int], object]
        """Fill the states from the replies that are not doubted; argument: time in ns. Set by the kernel."""
        self._joint_speed = self.scale[1].copy()
        self._wheel_speed = np.array([servo.direction * _in_wheel_mode(servo) for servo in servos])
        self.modes = b""  # Modes of the robot at the last `follow_modes`
        self.devices = DeviceSamples(plans, sources, reports)
        """Samples of all devices, filled from the same replies."""
        first_servo = first_block = 0
        buses = []
        for number, plan in enumerate(plans):
            buses.append(BusSamples(number, plan, self, first_servo, first_block))
            first_servo += len(plan.servos)
            first_block += len(plan.members) - len(plan.servos)
        self.buses = tuple(buses)  # Samples of each bus

    def follow_modes(self) -> None:
        """Use the unit of velocity that belongs to each servo's present mode. Call before replies are
        processed."""
        self.modes = self.states.mode.tobytes()
        turning = np.isin(self.states.mode[self.rows], _WHEEL_MODES)
        self.scale[1] = np.where(turning, self._wheel_speed, self._joint_speed)

    def fill_states(self, now_ns: int) -> None:
        """Fill the states of all joints and devices from the replies of this cycle.

        The row of a servo without a reply, or with an implausible one, keeps its values, is marked
        invalid, and its age grows."""
        if self.settle_all(now_ns):
            self.accept_plausible(now_ns)

    def accept_plausible(self, now_ns: int) -> None:
        """Check the positions and device values of this cycle, fill the states from the plausible ones,
        and report the others."""
        steps = self.values[0] - self.states.position[self.rows]
        for index in self.jumps.suspects(steps, self.fresh):
            elapsed_ns = int(self.at_ns[index] - self.shown_ns[index])
            counts_on = self.shown_ns[index] > self.recounted_ns[index]
            if counts_on and not self.jumps.can_be(index, float(steps[index]), elapsed_ns, now_ns):
                self.doubted[index] = True
                # A rejected reply does not count: the age refers to the last sample that was shown.
                self.at_ns[index] = self.shown_ns[index]
        self.devices.reject_non_finite(now_ns)
        self.show(now_ns)


class BusSamples:
    """Part of `Samples` for one bus, as views of its arrays: first the servos of the bus, then the blocks
    of its devices."""

    def __init__(self, number: int, plan: BusPlan, samples: Samples, first: int, first_block: int) -> None:
        here = slice(first, first + len(plan.servos))
        blocks = slice(first_block, first_block + len(plan.members) - len(plan.servos))
        self._samples = samples
        self._number = number
        self._here = here
        self.fresh = samples.fresh[here]
        """True for each servo whose intact reply arrived in this cycle, shape (servos of the bus,)."""
        self.blocks_fresh = samples.devices.fresh[blocks]
        """True for each block of a device that arrived in this cycle, shape (blocks of the bus,)."""
        self.blocks_at_ns = samples.devices.at_ns[blocks]
        """Arrival time of the newest reply of each block, ns; -1 before the first reply."""
        self.at_ns = samples.at_ns[here]
        """Arrival time of each servo's newest plausible reply, ns; -1 before the first reply."""

    def clear_fresh(self) -> None:
        """Begin a cycle: mark the states of all servos and blocks as not received."""
        self.fresh[:] = False
        self.blocks_fresh[:] = False

    def restart_count(self, servo: int) -> None:
        """Accept the next position of a servo at any distance from the last: a reboot reset its turn
        count."""
        self._samples.recounted_ns[self._here][servo] = self.at_ns[servo]

    def place_servo(self, servo: int, placed: ServoPlan) -> None:
        """Convert the positions of a servo with another zero from now on."""
        self._samples.reference[self._here][servo] = placed.zero

    def arrived(self, member: int) -> bool:
        """Return True if an intact reply of this member of the plan arrived in this cycle."""
        servos = len(self.fresh)
        return bool(self.fresh[member] if member < servos else self.blocks_fresh[member - servos])

    def store_state(self, servo: int, data: bytes | memoryview, at_ns: int) -> None:
        """Store the reply of a member of the plan, which arrived at `at_ns`."""
        self._samples.take(self._number, servo, bytes(data), at_ns)


class Jumps:
    """Check of positions for implausible jumps: a servo cannot move further than its speed allows.

    A step is possible up to the servo's highest speed limit times the time since its last good sample. A
    servo that really is elsewhere is therefore accepted again after a moment. Steps are in the order of
    the plans' servos."""

    def __init__(self, plans: Iterable[BusPlan], reports: ReportSink) -> None:
        self._reports = reports
        both = [(plan, servo) for plan in plans for servo in plan.servos]
        self._servos = [servo for _, servo in both]
        speeds = [np.inf if servo.wraps else _most_speed(plan, servo) for plan, servo in both]
        ratios = np.array([servo.ratio for _, servo in both], dtype=np.float64)
        self._fastest = np.array(speeds, dtype=np.float64) * ratios
        self.always_possible: Floats = self._fastest * MARGIN_NS * 1e-9 + MARGIN_RAD * ratios
        """Step of each servo that is possible at any time after a good sample, rad or m."""
        self._mask = np.zeros(len(both), dtype=np.bool_)
        self._reported_ns = [-REPORT_AGAIN_NS] * len(both)

    def suspects(self, steps: Floats, fresh: NDArray[np.bool_]) -> list[int]:
        """Return the indices of the `fresh` servos whose step (rad or m) needs the closer check of
        `can_be`."""
        np.greater(np.abs(steps), self.always_possible, self._mask)
        return np.flatnonzero(self._mask & fresh).tolist()

    def can_be(self, index: int, step: float, elapsed_ns: int, now_ns: int) -> bool:
        """Return True if a servo can have made this step (rad or m) within `elapsed_ns`; otherwise report
        an implausible value."""
        reach = self.always_possible[index] + self._fastest[index] * elapsed_ns * 1e-9
        if abs(step) <= reach:
            return True
        if now_ns - self._reported_ns[index] >= REPORT_AGAIN_NS:
            self._reported_ns[index] = now_ns
            servo = self._servos[index]
            text = reports.jumped(servo.joint, servo.unit.text(abs(step), digits=0), elapsed_ns)
            self._reports.report(Reason.IMPLAUSIBLE, servo.joint, text)
        return False


def _units(servo: ServoPlan) -> tuple[float, float, float]:
    units = servo.position_per_tick, servo.rad_s_per_tick * servo.ratio, servo.effort_per_tick
    position, velocity, effort = (servo.direction * unit for unit in units)
    return position, velocity, effort


def _in_wheel_mode(servo: ServoPlan) -> float:
    """Return the unit of the present speed in wheel mode, rad/s or m/s of the joint per tick."""
    units = [mode.present_rad_s_per_tick for mode in servo.modes if mode.mode == Mode.VELOCITY]
    return (units[0] if units else servo.rad_s_per_tick) * servo.ratio


def _most_speed(plan: BusPlan, servo: ServoPlan) -> float:
    """Return the highest speed that a servo's registers allow, rad/s. A profile may be faster than the
    velocity limit.

    Velocity Limit (44) of an X servo ends at 1023, Profile Velocity (112) at 32767 (e-Manual XM430-W350)."""
    limit = find_table(servo.model, plan.protocol).items.get("velocity_limit")
    ticks = servo.max_speed_tick if limit is None else min(servo.max_speed_tick, limit.maximum)
    return ticks * servo.rad_s_per_tick
