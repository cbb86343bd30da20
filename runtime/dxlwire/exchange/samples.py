"""Samples: replies of a cycle -> states of the whole robot in SI units; implausible jumps are no samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from dxlwire.bus_plan import BusPlan, ServoPlan
from dxlwire.control_table import find_table
from dxlwire.exchange.arrays import Floats, JointArrays, SourceArrays
from dxlwire.exchange.device_samples import DeviceSamples
from dxlwire.exchange.reports import Reason, ReportSink
from dxlwire.modes import Mode

_WHEEL_MODES = (Mode.VELOCITY, Mode.PWM)

MARGIN_RAD = 0.035  # rad, two degrees: noise of a potentiometer, and what a hand adds [i]
MARGIN_NS = 10_000_000
"""A reply may be that much later than the one before was, so that less time seems to have passed."""
REPORT_AGAIN_NS = 1_000_000_000  # One servo has at most one event in this time


class Samples:
    """Fills the states of all servos at once; arrays have one column a servo, in the order of the plans.

    Position: q = direction * (raw * rad_per_tick - reference) * ratio, rad or m. The sign of velocity and
    effort follows the joint's direction, so positive effort is torque toward growing q. In wheel mode the
    speed of a model that controls none is a fraction of full output (AX-12A, Present Speed (38)), see
    `mode_plan`.
    """

    def __init__(
        self,
        plans: Sequence[BusPlan],
        states: JointArrays,
        sources: SourceArrays,
        reports: ReportSink,
    ) -> None:
        servos = [servo for plan in plans for servo in plan.servos]
        self.states = states  # Of the robot; filled here
        self.rows = np.array([servo.row for servo in servos], dtype=np.intp)
        """Row of each servo's joint in the states."""
        self.values: Floats = np.full((3, len(servos)), np.nan)
        """Position, velocity and effort of each servo by its newest intact reply, SI units."""
        self.scale: Floats = np.array([_units(servo) for servo in servos]).reshape(-1, 3).T.copy()
        """Units of a tick of each value; that of the velocity follows the servo's mode."""
        self.reference: Floats = np.array(
            [servo.direction * servo.reference * servo.ratio for servo in servos]
        )
        """rad or m, subtracted from each position."""
        self.fresh = np.zeros(len(servos), dtype=np.bool_)
        """True where an intact reply arrived in this cycle."""
        self.at_ns = np.full(len(servos), -1, dtype=np.int64)
        """Time at which the newest plausible reply arrived; -1 while none ever did."""
        self.shown_ns = self.at_ns.copy()
        """The same as of the end of the cycle before: the time of the sample that the states show."""
        self.recounted_ns = np.full(len(servos), -2, dtype=np.int64)
        """Time of the last sample before a servo began to count its turns again; -2: it did not."""
        self.doubted = np.zeros(len(servos), dtype=np.bool_)
        """True where the reply of this cycle is not believed."""
        self.jumps = Jumps(plans, reports)
        self.take: Callable[[int, int, bytes, int], object]
        """Takes what a member of a bus answered, both by their index, and when it came; of the kernel."""
        self.settle_all: Callable[[int], int]
        """Fills the states at a time from the replies of this cycle; or returns another number than 0, having
        filled none, where something is to be judged."""
        self.show: Callable[[int], object]
        """Fills the states at a time from those replies that are not doubted."""
        self._joint_speed = self.scale[1].copy()
        self._wheel_speed = np.array([servo.direction * _in_wheel_mode(servo) for servo in servos])
        self.modes = b""  # The robot's modes, as of the last `follow_modes`
        self.devices = DeviceSamples(plans, sources, reports)
        """Where the replies of devices go."""
        first_servo = first_block = 0
        buses = []
        for number, plan in enumerate(plans):
            buses.append(BusSamples(number, plan, self, first_servo, first_block))
            first_servo += len(plan.servos)
            first_block += len(plan.members) - len(plan.servos)
        self.buses = tuple(buses)  # Where the replies of each bus go

    def follow_modes(self) -> None:
        """Use the unit of velocity that belongs to each servo's mode; before replies are taken."""
        self.modes = self.states.mode.tobytes()
        turning = np.isin(self.states.mode[self.rows], _WHEEL_MODES)
        self.scale[1] = np.where(turning, self._wheel_speed, self._joint_speed)

    def settle(self, now_ns: int) -> None:
        """Fill the states from the replies of this cycle.

        The row of a servo without a reply, or with an implausible one, keeps its values, is invalid, and its
        age grows.
        """
        if self.settle_all(now_ns):
            self.judge(now_ns)

    def judge(self, now_ns: int) -> None:
        """Fill the states from those replies of this cycle that can be true."""
        steps = self.values[0] - self.states.position[self.rows]
        for index in self.jumps.suspects(steps, self.fresh):
            elapsed_ns = int(self.at_ns[index] - self.shown_ns[index])
            counts_on = self.shown_ns[index] > self.recounted_ns[index]
            if counts_on and not self.jumps.can_be(index, float(steps[index]), elapsed_ns, now_ns):
                self.doubted[index] = True
                self.at_ns[index] = self.shown_ns[index]
        self.devices.judge(now_ns)
        self.show(now_ns)


class BusSamples:
    """The part of one bus: its servos are columns of the arrays of `Samples`; its devices' blocks follow."""

    def __init__(self, number: int, plan: BusPlan, samples: Samples, first: int, first_block: int) -> None:
        here = slice(first, first + len(plan.servos))
        blocks = slice(first_block, first_block + len(plan.members) - len(plan.servos))
        self._samples = samples
        self._number = number
        self._here = here
        self.fresh = samples.fresh[here]
        """True where an intact reply arrived in this cycle; shape (servos of the bus,)."""
        self.blocks_fresh = samples.devices.fresh[blocks]
        """The same of the devices' blocks; shape (blocks of the bus,)."""
        self.blocks_at_ns = samples.devices.at_ns[blocks]
        """Time at which the newest reply of each block arrived; -1 while none ever did."""
        self.at_ns = samples.at_ns[here]
        """Time at which the newest plausible reply arrived; -1 while none ever did."""

    def clear(self) -> None:
        """Begin a cycle: nothing has arrived."""
        self.fresh[:] = False
        self.blocks_fresh[:] = False

    def restart_count(self, servo: int) -> None:
        """Believe the next position of a servo, however far it is: a reboot took it back into one turn."""
        self._samples.recounted_ns[self._here][servo] = self.at_ns[servo]

    def arrived(self, member: int) -> bool:
        """Check whether an intact reply of a member of the plan arrived in this cycle."""
        servos = len(self.fresh)
        return bool(self.fresh[member] if member < servos else self.blocks_fresh[member - servos])

    def take(self, servo: int, data: bytes | memoryview, at_ns: int) -> None:
        """Keep what a member of the plan, by its index, answered to the read of its state."""
        self._samples.take(self._number, servo, bytes(data), at_ns)


class Jumps:
    """Checks whether a position can be true: one that is further from the last than the servo can have turned
    is no sample. Steps are in the order of the plans' servos.

    What is possible is the servo's highest speed limit times the time since its last good sample, so that a
    servo that really stands elsewhere is believed again after a moment.
    """

    def __init__(self, plans: Iterable[BusPlan], reports: ReportSink) -> None:
        self._reports = reports
        both = [(plan, servo) for plan in plans for servo in plan.servos]
        self._servos = [servo for _, servo in both]
        speeds = [np.inf if servo.wraps else _most_speed(plan, servo) for plan, servo in both]
        ratios = np.array([servo.ratio for _, servo in both], dtype=np.float64)
        self._fastest = np.array(speeds, dtype=np.float64) * ratios
        self.always_possible: Floats = self._fastest * MARGIN_NS * 1e-9 + MARGIN_RAD * ratios
        """rad or m; a step up to this is possible, whenever the sample before was."""
        self._mask = np.zeros(len(both), dtype=np.bool_)
        self._reported_ns = [-REPORT_AGAIN_NS] * len(both)

    def suspects(self, steps: Floats, fresh: NDArray[np.bool_]) -> list[int]:
        """Return which of the `fresh` servos made a step that may be too far, by index; steps in rad."""
        np.greater(np.abs(steps), self.always_possible, self._mask)
        return np.flatnonzero(self._mask & fresh).tolist()

    def can_be(self, index: int, step: float, elapsed_ns: int, now_ns: int) -> bool:
        """Check whether a servo can have made a step in this time; report it if it cannot."""
        reach = self.always_possible[index] + self._fastest[index] * elapsed_ns * 1e-9
        if abs(step) <= reach:
            return True
        if now_ns - self._reported_ns[index] >= REPORT_AGAIN_NS:
            self._reported_ns[index] = now_ns
            servo, time = self._servos[index], elapsed_ns * 1e-6
            name, jump = servo.joint, servo.step_text(abs(step))
            text = f"{name} jumped by {jump} in {time:.0f} ms, faster than it can turn: not believed"
            self._reports.report(Reason.IMPLAUSIBLE, name, text)
        return False


def _units(servo: ServoPlan) -> tuple[float, float, float]:
    units = servo.position_per_tick, servo.rad_s_per_tick * servo.ratio, servo.effort_per_tick
    position, velocity, effort = (servo.direction * unit for unit in units)
    return position, velocity, effort


def _in_wheel_mode(servo: ServoPlan) -> float:
    """Return the unit of the present speed in wheel mode, rad/s or m/s of the joint."""
    units = [mode.present_rad_s_per_tick for mode in servo.modes if mode.mode == Mode.VELOCITY]
    return (units[0] if units else servo.rad_s_per_tick) * servo.ratio


def _most_speed(plan: BusPlan, servo: ServoPlan) -> float:
    """Return the highest speed of a servo, rad/s: a profile may be set to more than the velocity limit.

    Velocity Limit (44) of an X servo ends at 1023, Profile Velocity (112) at 32767 (e-Manual XM430-W350).
    """
    limit = find_table(servo.model, plan.protocol).items.get("velocity_limit")
    ticks = servo.max_speed_tick if limit is None else min(servo.max_speed_tick, limit.maximum)
    return ticks * servo.rad_s_per_tick
