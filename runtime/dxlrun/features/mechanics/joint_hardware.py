"""Joint hardware: hardware interface with joints for the loop, on top of the hardware with servos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import LIMP, Torque
from dxlrun.channels.event_records import EventSink
from dxlrun.contract.hardware import Hardware
from dxlrun.dynamixel.hardware_layer import HardwareLayer
from dxlrun.features.mechanics import texts
from dxlrun.features.mechanics.joint_arrays import CoupledJointArrays
from dxlrun.plan.loop_plan import LimitedInterface, LoopPlan, ServoLimit
from dxlrun.plan.mechanics_plan import CouplingPlan, MechanicsPlan
from dxlwire.bus_plan import BusPlan, ServoPlan
from dxlwire.exceptions import help_link

FADE_NS = 1_000_000_000
"""Time in which deviations between servos at the start are removed from their goals, ns: at most 1.5 deg per
second with the default tolerance."""
AGREES = 0.7  # share of the tolerance below which servos that disagreed agree again
_HAS_TORQUE = (Torque.ON, Torque.DOUBT, Torque.GIVEN)

Done = Callable[[str], None]
RegisterDone = Callable[[str, int | None], None]


class _CouplingRequest(msgspec.Struct):
    """A request (such as torque off) sent to all servos of a coupling, while some have not answered."""

    left: int
    answers: list[Done] = []
    problems: list[str] = []


class CouplingCheck:
    """Checks during a run that the servos of each coupling agree in position and torque; reports events."""

    def __init__(
        self,
        plan: MechanicsPlan,
        loop: LoopPlan,
        buses: Sequence[BusPlan],
        arrays: CoupledJointArrays,
        events: EventSink,
    ) -> None:
        placed = {servo.row: (bus, servo) for bus in buses for servo in bus.servos}
        self._servos: list[ServoPlan] = [placed[row][1] for row in range(len(plan.servos))]
        self._labels = [f"ID {servo.servo_id} on bus {bus.name}" for bus, servo in _in_order(placed)]
        self._joints = loop.joints
        self._plan = plan
        self._arrays = arrays
        self._events = events
        self._apart = [False] * len(plan.couplings)

    def label(self, row: int) -> str:
        """Return ID and bus of a servo as text; `row` is its row in the servos' arrays."""
        return self._labels[row]

    def at_start(self) -> list[str]:
        """Return why joints with several servos must not get torque at start, in sentences; empty if fine.

        Joints that stay limp at the start (`torque: off`) are not checked.
        """
        self._arrays.fill_joint_states()
        problems: list[str] = []
        for index, coupling in enumerate(self._plan.couplings):
            if any(self._servos[row].torque_at_start for row in coupling.servos):
                problems += self.unfit(index)
        return problems

    def torque_refused(self, index: int) -> str:
        """Return why the servos of a coupling must not get torque where they are; empty if they may.

        It is also empty if they have torque already. Each servo is checked against its own range when it gets
        torque. That is not enough: a wrist can be outside its limits with both servos inside theirs.
        """
        coupling = self._plan.couplings[index]
        if not any(self._arrays.servo_states.torque[row] in LIMP for row in coupling.servos):
            return ""
        return "; ".join(self.unfit(index))

    def report_no_torque(self, index: int, problem: str) -> None:
        """Emit the event that torque was refused for a coupling, with the problem."""
        name = self._plan.couplings[index].name
        self._events.emit_event(name, texts.torque_refused(name, problem))

    def unfit(self, index: int) -> list[str]:
        """Return why a coupling's servos must not get torque: disagreement, or a joint beyond its limits."""
        coupling = self._plan.couplings[index]
        if self._spread(index, coupling) > coupling.tolerance > 0:
            return [
                f"{self._disagreement(index, coupling)}: check reference and direction of each servo, and "
                "the mechanism between them"
            ]
        problems: list[str] = []
        for row in coupling.joints:
            joint, position = self._joints[row], float(self._arrays.states.position[row])
            # Allow one tick beyond the limits for rounding.
            tick = max(self._servos[servo].position_per_tick for servo in coupling.servos)
            if not joint.bounded or joint.lower - tick <= position <= joint.upper + tick:
                continue
            first = self._servos[coupling.servos[0]]
            problems.append(
                f"{joint.label} is at {first.position_text(position)}, outside its limits "
                f"{first.position_text(joint.lower)}..{first.position_text(joint.upper)}: move the joint "
                f"inside by hand; {help_link('a-joint-is-outside-its-limits')}"
            )
        return problems

    def report_disagreement(self) -> None:
        """Emit an event when servos of a coupling start to disagree beyond the tolerance, or agree again."""
        for index, coupling in enumerate(self._plan.couplings):
            if not coupling.tolerance or not self._arrays.states.valid[coupling.joints[0]]:
                continue
            spread, apart = self._spread(index, coupling), self._apart[index]
            if not apart and spread > coupling.tolerance:
                self._apart[index] = True
                event = texts.servos_disagree(self._disagreement(index, coupling))
                self._events.emit_event(coupling.name, event)
            elif apart and spread < AGREES * coupling.tolerance:
                self._apart[index] = False
                first = self._servos[coupling.servos[0]]
                event = texts.servos_agree_again(coupling.name, first.position_text(spread))
                self._events.emit_event(coupling.name, event)

    def partners(self) -> list[tuple[int, tuple[int, ...], tuple[int, ...]]]:
        """Return couplings of which only some servos have torque: index, rows without it, rows with it."""
        torque = self._arrays.servo_states.torque
        found = []
        for index, coupling in enumerate(self._plan.couplings):
            limp = tuple(row for row in coupling.servos if torque[row] in LIMP)
            pulling = tuple(row for row in coupling.servos if torque[row] in _HAS_TORQUE)
            if limp and pulling:
                found.append((index, limp, pulling))
        return found

    def report_torque_off(self, index: int, limp: Sequence[int], pulling: Sequence[int]) -> None:
        """Emit the event that servos lose torque because others of their coupling have none."""
        name, labels = self._plan.couplings[index].name, self._labels
        event = texts.partners_released(name, [labels[row] for row in limp], [labels[row] for row in pulling])
        self._events.emit_event(name, event)

    def _spread(self, index: int, coupling: CouplingPlan) -> float:
        """Return by how much the servos of a coupling disagree, rad or m, at their outputs."""
        residual = self._arrays.residual[index, : len(coupling.servos)]
        return float(residual.max() - residual.min())

    def _disagreement(self, index: int, coupling: CouplingPlan) -> str:
        residual = self._arrays.residual[index, : len(coupling.servos)]
        position = self._arrays.servo_states.position
        high, low = (coupling.servos[place] for place in (int(residual.argmax()), int(residual.argmin())))
        servo = self._servos[high]
        spread = servo.position_text(self._spread(index, coupling))
        return (
            f"the servos of {coupling.name} disagree by {spread}, "
            f"more than its tolerance of {servo.position_text(coupling.tolerance)}: {self._labels[high]} "
            f"reports {servo.position_text(float(position[high]))}, {self._labels[low]} reports "
            f"{servo.position_text(float(position[low]))}"
        )


class JointHardware(HardwareLayer):
    """Hardware with joints as rows, which converts and forwards to a hardware with servos as rows.

    The servos' hardware uses `arrays.servo_states` and `arrays.servo_goals`. A request for a joint applies to
    all its servos, and so to all joints of its transmission. It is answered when all servos have answered.
    """

    def __init__(
        self,
        hardware: Hardware,
        plan: MechanicsPlan,
        arrays: CoupledJointArrays,
        together: CouplingCheck,
        period_ns: int,
    ) -> None:
        super().__init__(hardware)
        self._plan = plan
        self._arrays = arrays
        self._together = together
        self._fade_share = period_ns / FADE_NS
        self._asked: dict[tuple[int, str], _CouplingRequest] = {}
        """Open requests by coupling index and kind (`on`, `off`, `reboot`) that some servos have not
        answered."""
        self._read_limits: Mapping[int, Sequence[ServoLimit]] | None = None
        """Servo limits of the last call, to see whether `_joint_limits` must be computed again."""
        self._joint_limits: Mapping[int, Sequence[ServoLimit]] = {}

    def start(self, engaging: Callable[[], None] = lambda: None) -> None:
        """Start the servos' hardware, and set the joints' goals such that no servo moves.

        `CouplingCheck.at_start` refuses disagreeing servos of a joint before that.

        Args:
            engaging: Called before any servo gets torque.
        """
        self._hardware.start(engaging)
        self._arrays.fill_joint_goals()
        self._arrays.fill_joint_states()

    @property
    def servo_limits(self) -> Mapping[int, Sequence[ServoLimit]]:
        """Limits of each joint by row, from registers of its servos, while coupled joints rest."""
        own = self._hardware.servo_limits
        if own is self._read_limits:
            return self._joint_limits
        found = {joint: tuple(own.get(servo, ())) for joint, servo in self._plan.direct}
        for coupling in self._plan.couplings:
            for column, joint in enumerate(coupling.joints):
                found[joint] = self._limits_of(coupling, column, own)
        self._read_limits, self._joint_limits = own, found
        return found

    def _limits_of(
        self, coupling: CouplingPlan, column: int, own: Mapping[int, Sequence[ServoLimit]]
    ) -> tuple[ServoLimit, ...]:
        """Return the tightest velocity, effort and PWM limit of one joint from its servos' registers."""
        tightest: dict[LimitedInterface, ServoLimit] = {}
        for place, servo in enumerate(coupling.servos):
            factors = {
                "velocity": abs(coupling.inverse[place][column]),
                "effort": abs(coupling.matrix[column][place]),
                "pwm": float(len(coupling.joints) == 1),
            }
            for limit in own.get(servo, ()):
                factor = factors[limit.interface]
                if not factor:
                    continue
                value = limit.value / factor
                if limit.interface not in tightest or value < tightest[limit.interface].value:
                    text = f"{limit.text} ({self._together.label(servo)})"
                    tightest[limit.interface] = ServoLimit(limit.interface, value, text)
        return tuple(tightest.values())

    def read_states(self) -> None:
        """Read servos, compute joint states; if one servo of a coupling is limp, release its other servos."""
        self._hardware.read_states()
        self._arrays.fill_joint_states()
        self._together.report_disagreement()
        for index, limp, pulling in self._together.partners():
            if not any(coupling == index for coupling, _ in self._asked):
                self._together.report_torque_off(index, limp, pulling)
                self._ask(index, "off", pulling, lambda _: None)

    def write_goals(self) -> None:
        """Convert the joints' goals into servo goals and send them."""
        self._arrays.fade(self._fade_share)
        self._arrays.fill_servo_goals()
        self._hardware.write_goals()

    def set_modes(self, modes: NDArray[np.uint8]) -> None:
        """Change the operating mode of joints; `modes` has one per joint, UNKNOWN for no change."""
        self._hardware.set_modes(self._arrays.joint_requests(modes))

    def write_register(self, row: int, item: str, value: int, done: RegisterDone) -> None:
        """Write an item of all servos of a joint; `done` gets the problem and the first servo's old value.

        A row after those of the joints is that of a single servo, here and in `read_register`.
        """
        self._registers(
            row, lambda servo, each: self._hardware.write_register(servo, item, value, each), done
        )

    def read_register(self, row: int, item: str, done: RegisterDone) -> None:
        """Read an item of all servos of a joint; `done` gets a problem, also if they differ, and a value."""
        self._registers(
            row, lambda servo, each: self._hardware.read_register(servo, item, each), done, alike=True
        )

    def switch_torque(self, row: int, on: bool, done: Done) -> None:
        """Switch torque of all servos of a joint; on is refused if they disagree or exceed the limits."""
        index = self._coupling(row)
        servos = self._plan.servo_rows(row)
        if index is None:
            self._hardware.switch_torque(servos[0], on, done)
        elif on and (problem := self._together.torque_refused(index)):
            # one report is enough for all joints of a transmission
            if row == self._plan.couplings[index].joints[0]:
                self._together.report_no_torque(index, problem)
            done(problem)
        else:
            self._ask(index, "on" if on else "off", servos, done)

    def follow_goals(self, rows: Sequence[int]) -> None:
        """Make joints that got torque start from their present positions and follow the goals."""
        for index in dict.fromkeys(self._coupling(row) for row in rows):
            if index is not None:
                self._arrays.anchor(index)
        self._hardware.follow_goals([servo for row in rows for servo in self._plan.servo_rows(row)])

    def reboot_servo(self, row: int, done: Done) -> None:
        """Reboot all servos of a joint; `done` gets the problem, empty on success."""
        index = self._coupling(row)
        servos = self._plan.servo_rows(row)
        if index is None:
            self._hardware.reboot_servo(servos[0], done)
        else:
            self._ask(index, "reboot", servos, done)

    def _coupling(self, row: int) -> int | None:
        """Return the index of the coupling that moves a joint; None if the joint has a servo of its own."""
        places = (index for index, one in enumerate(self._plan.couplings) if row in one.joints)
        return next(places, None)

    def _ask(self, index: int, what: str, servos: Sequence[int], done: Done) -> None:
        """Send torque `on`, `off` or `reboot` to servos of a coupling; an open one of that kind is shared."""
        waiting = self._asked.get((index, what))
        if waiting is not None:  # for another joint of the same transmission
            waiting.answers.append(done)
            return
        self._asked[index, what] = _CouplingRequest(len(servos), [done])
        for servo in servos:
            answer = partial(self._answered, index, what)
            if what == "reboot":
                self._hardware.reboot_servo(servo, answer)
            else:
                self._hardware.switch_torque(servo, what == "on", answer)

    def _answered(self, index: int, what: str, problem: str) -> None:
        asked = self._asked[index, what]
        asked.left -= 1
        if problem:
            asked.problems.append(problem)
        if not asked.left:
            del self._asked[index, what]
            for answer in asked.answers:
                answer("; ".join(asked.problems))

    def _registers(
        self,
        row: int,
        request: Callable[[int, RegisterDone], None],
        done: RegisterDone,
        *,
        alike: bool = False,
    ) -> None:
        """Send a register request to all servos of a joint, or one servo; call `done` after all answers."""
        joints = len(self._arrays.states.valid)
        servos = self._plan.servo_rows(row) if row < joints else (row - joints,)
        found: dict[int, tuple[str, int | None]] = {}

        def answered(servo: int, problem: str, value: int | None) -> None:
            found[servo] = problem, value
            if len(found) < len(servos):
                return
            problems = [text for text, _ in (found[one] for one in servos) if text]
            values = [found[one][1] for one in servos]
            if alike and not problems and len(set(values)) > 1:
                each = ", ".join(f"{self._together.label(one)} has {found[one][1]}" for one in servos)
                problems.append(f"its servos have different values: {each}")
            done("; ".join(problems), values[0])

        for servo in servos:
            request(servo, partial(answered, servo))


def _in_order(placed: dict[int, tuple[BusPlan, ServoPlan]]) -> list[tuple[BusPlan, ServoPlan]]:
    return [placed[row] for row in sorted(placed)]
