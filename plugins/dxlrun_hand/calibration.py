"""`dxlrun calibrate`: the user moves limp joints to zero and to both ends while their servos are read.

s = direction * (theta - reference) * ratio, where theta is the angle of the servo and s the position of its
joint (`description/joints/mechanics.py`). The zero pose gives the reference, the end that the user calls
positive gives the direction, and the two ends give the limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec

from dxlrun import LINEAR, ROTARY, JointUnit, ServoFault
from dxlrun.tooling.files import KeyPath
from dxlrun.tooling.output import choose_remedy
from dxlrun.tooling.robots import Replacement
from dxlrun.tooling.servos import OneServo, Search, ToolLine, find_servo
from dxlrun_hand.dialogue import Dialogue
from dxlrun_hand.robot_text import RobotText
from dxlwire import BusPlan, ControlTable, ServoPlan, can_count_turns

_degrees = ROTARY.number
LEAST_WAY = math.radians(5.0)
"""Smallest angle of the servo between both ends, rad; on a shorter way the hand may have slipped."""
_STEPS: Mapping[JointUnit, float] = {ROTARY: math.radians(0.1), LINEAR: 1e-4}
"""Steps to which measured limits are rounded inwards, rad and m; beyond them the joint is at its stop."""
_READINGS = 5
"""Number of readings of a joint at rest, whose median is its position."""
_SHIFTING = {
    "drive_mode": (0x01, 0),
    "multi_turn_offset": (-1, 0),
    "resolution_divider": (-1, 1),
}
"""Control table items that shift or scale the servo's position: mask of the relevant bits, and the only value
with which a joint is calibrated."""


class JointCalibration(msgspec.Struct, frozen=True):
    """Measured calibration of a joint, for its keys reference, direction and limits in the robot file."""

    joint: str
    reference: float
    """Angle of the servo in the zero pose of the joint, rad from its raw position 0."""
    direction: int
    """1 if the servo's angle rises in the positive direction of the joint, else -1."""
    limits: tuple[float, float] | None
    """Lower and upper position limit of the joint, rad or m; None for a continuous joint."""
    unit: JointUnit
    tick: float
    """Resolution of the servo's angle, rad."""
    ratio: float
    """Travel of the joint per rad of its servo, rad or m."""


class TurnRangeFault(ServoFault):
    """Error of a servo that was turned by hand beyond the range of its positions."""


class HandJoint:
    """Limp joint with one servo, which is read while it is moved by hand."""

    def __init__(self, tool: ToolLine, plan: BusPlan, servo: ServoPlan) -> None:
        """Search for the servo of a joint on its bus, and check its model and settings. Nothing is written.

        Args:
            tool: Open line of the bus.
            plan: Plan of the bus.
            servo: Plan of the joint's servo.

        Raises:
            ServoFault: The servo does not answer, is another model, or has settings that shift its
                angles.
        """
        self.name, self.servo = servo.joint, servo
        self._label = plan.label(servo)
        self._port = plan.port
        search = Search((plan.protocol,), (plan.baud_rate,), (servo.servo_id,))
        found = find_servo(tool, servo.servo_id, search)
        if not found:
            remedy = choose_remedy(plan.port, "check power, cable, and ID", simulated="check its ID")
            raise ServoFault(f"{self._label} does not answer at {plan.baud_rate} bit/s; {remedy}")
        self._one = OneServo(tool, found[0])
        self.table: ControlTable = self._one.table
        if self.table.model_number != servo.model_number:
            raise ServoFault(
                f"{self._label} is an {self.table.model}, not an {servo.model}; correct the robot "
                "file, or set up the servo with `dxlrun setup`"
            )
        names = [name for name in _SHIFTING if name in self.table.items]
        for name, value in self._one.read_items(names).items():
            bits, only = _SHIFTING[name]
            if value & bits != only:
                title = self.table.items[name].title
                raise ServoFault(f"{self._label}: {title} = {value} shifts its angles; write {only}")
        self.offset = self._one.read_offset()
        """Homing Offset that the servo adds to its angle, ticks; the angles of this object are without it."""
        self._turn = round(math.tau / self.table.rad_per_tick)
        self._raw = self._travelled = 0
        self.limp = False
        """True if this object switched the torque off."""

    def let_go(self) -> None:
        """Switch the servo's torque off, so that the joint can be moved by hand."""
        # Set the flag first: the servo can be limp even if its reply is lost.
        self.limp = True
        self._one.torque(False)

    def start_counting(self, zero: float | None = None) -> float:
        """Start counting the servo's turns; return its angle, rad, within the turn that its goals reach.

        If the servo can count turns, this is the turn in which it is closest to the angle `zero`, rad, in the
        zero pose.
        """
        readings = sorted(self._read_raw() for _ in range(_READINGS))
        self._raw = readings[_READINGS // 2]
        # A servo that counted turns, such as in wheel mode, is in its first turn after power-up.
        first = float(self.table.min_tick)
        if zero is not None and self.counts_turns:
            first = zero / self.table.rad_per_tick - self._turn / 2
        self._travelled = self._raw + math.ceil((first - self._raw) / self._turn) * self._turn
        return self._angle

    @property
    def counts_turns(self) -> bool:
        """True if goals reach every angle, because the servo can count turns and the joint is bounded."""
        return not self.servo.continuous and can_count_turns(self.table)

    def read_angle(self) -> float:
        """Read the servo; return its angle, rad, counted across turns since `begin`.

        Raises:
            ServoFault: The servo does not answer.
        """
        raw = self._read_raw()
        step = raw - self._raw
        if 2 * abs(step) > self._turn:  # The position wraps around at the end of a turn
            step -= round(step / self._turn) * self._turn
        self._raw = raw
        self._travelled += step
        return self._angle

    def check_turn(self, lowest: float, highest: float) -> None:
        """Check that the servo of a joint that is not continuous stayed within the angles its goals reach.

        Args:
            lowest: Lowest angle of the servo, rad.
            highest: Highest angle of the servo, rad.

        Raises:
            BeyondTurn: The servo left this range.
        """
        tick = self.table.rad_per_tick
        least, most = self.table.min_tick * tick, self.table.max_tick * tick
        if self.counts_turns:
            least, most = lowest, lowest + self._turn * tick
        if not self.servo.continuous and (lowest < least - tick or highest > most + tick):
            raise TurnRangeFault(
                f"{self.name} left the range of its {self.table.model}: goals are {_degrees(least)} to "
                f"{_degrees(most)} deg, and its servo was at {_degrees(lowest)} to {_degrees(highest)} deg. "
                f"{self._remedy} Move the joint back."
            )

    @property
    def _remedy(self) -> str:
        if self.counts_turns:
            return "If the joint needs more than a turn, write its limits yourself."
        return "If the joint needs this range, turn the servo's horn first."

    @property
    def _angle(self) -> float:
        return self._travelled * self.table.rad_per_tick

    def _read_raw(self) -> int:
        try:
            return self._one.read_items(["present_position"])["present_position"] - self.offset
        except ServoFault:
            remedy = choose_remedy(self._port)
            raise ServoFault(f"{self._label} no longer answers; {remedy}") from None


def measure_joints(joints: Sequence[HandJoint], dialogue: Dialogue) -> list[JointCalibration]:
    """Guide the user through zero pose and ends of joints; return their calibrations.

    The torque of all joints is off afterwards.

    Raises:
        ServoFault: A servo does not answer any more.
    """
    dialogue.ask_question("The torque will be switched off: hold the joints, and press Enter ")
    for joint in joints:
        joint.let_go()
        if joint.offset:
            title = joint.table.items["homing_offset"].title
            dialogue.print_lines(f"{joint.name}: {title} = {joint.offset} is not part of its angles.")
    names = ", ".join(joint.name for joint in joints)
    dialogue.ask_question(f"Move to the zero pose: {names}. Then press Enter ")
    zeros = [joint.start_counting() for joint in joints]
    return [_measure(joint, zero, dialogue) for joint, zero in zip(joints, zeros, strict=True)]


def _measure(joint: HandJoint, zero: float, dialogue: Dialogue) -> JointCalibration:
    servo = joint.servo
    while True:
        try:
            found = _ends(joint, zero, dialogue)
        except TurnRangeFault as error:
            dialogue.ask_question(f"{error} Then press Enter ")
            continue
        positive, negative, lowest, highest = found
        way = positive - (zero if servo.continuous else negative)
        if abs(way) >= LEAST_WAY:
            break
        dialogue.print_lines(f"{joint.name} moved only {_degrees(abs(way))} deg; move it further.")
    direction = 1 if way > 0 else -1
    limits = None
    if not servo.continuous:
        ends = [direction * (angle - zero) * servo.ratio for angle in (min(lowest, zero), max(highest, zero))]
        limits = _inside(min(ends), max(ends), servo.unit)
    return JointCalibration(
        joint.name, zero, direction, limits, servo.unit, joint.table.rad_per_tick, servo.ratio
    )


def _ends(joint: HandJoint, zero: float, dialogue: Dialogue) -> tuple[float, float, float, float]:
    """Ask the user to move a joint to its ends; return four angles of its servo, rad.

    They are the angles at the positive and at the other end, and the lowest and highest on the way. Raises
    BeyondTurn.
    """
    begin = joint.start_counting(zero)
    seen = [begin, begin]
    now = begin

    def show_angle() -> str:
        nonlocal now
        now = joint.read_angle()
        seen[:] = min(seen[0], now), max(seen[1], now)
        return f"  its servo is at {_degrees(now)} deg; range {_degrees(seen[0])} to {_degrees(seen[1])} deg"

    way = "in its positive direction" if joint.servo.continuous else "to its end in the positive direction"
    dialogue.ask_while(f"Move {joint.name} {way}, and press Enter", show_angle)
    show_angle()
    joint.check_turn(*seen)
    positive = now
    if not joint.servo.continuous:
        dialogue.ask_while(
            f"Move {joint.name} to its end in the negative direction, and press Enter", show_angle
        )
        show_angle()
        joint.check_turn(*seen)
    return positive, now, seen[0], seen[1]


def _inside(lower: float, upper: float, unit: JointUnit) -> tuple[float, float]:
    step = _STEPS[unit]
    return math.ceil(lower / step - 1e-6) * step, math.floor(upper / step + 1e-6) * step


# Changes of the robot file


def keys_of(joint: str, *, continuous: bool) -> list[KeyPath]:
    """Return the keys of a joint in the robot file that a calibration may change."""
    place: KeyPath = ("joints", joint)
    return [
        (*place, "reference"),
        (*place, "direction"),
        *([] if continuous else [(*place, "limits", "position")]),
    ]


def replacements(
    text: RobotText, servo: ServoPlan, limits: tuple[float, float] | None, found: JointCalibration
) -> list[Replacement]:
    """Return new values for the keys of a joint that differ from the robot file by more than a tick.

    Args:
        text: The robot file.
        servo: Plan of the joint's servo.
        limits: Position limits in the file, rad or m; None without limits.
        found: Measured calibration.
    """
    reference, direction, *position = keys_of(found.joint, continuous=servo.continuous)
    changes: list[Replacement] = []
    if abs(servo.encoder_reference - found.reference) > found.tick:
        changes.append(Replacement(reference, _written(found.reference, ROTARY, text.unit(reference))))
    if servo.direction != found.direction:
        changes.append(Replacement(direction, found.direction))
    if found.limits is not None:
        step = found.tick * found.ratio + _STEPS[found.unit]
        if limits is None or any(
            abs(old - new) > step for old, new in zip(limits, found.limits, strict=True)
        ):
            given = text.unit(position[0])
            ends = [_written(end, found.unit, given) for end in found.limits]
            changes.append(Replacement(position[0], ends))
    return changes


def _written(value: float, unit: JointUnit, given: str) -> str:
    if given == "rad":
        return f"{value + 0.0:.4f} rad"
    return unit.text(value, trim=True)
