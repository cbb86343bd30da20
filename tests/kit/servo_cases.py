"""Cases of servos as text: what is different about them, what happens, and what the runtime does about it.

The texts in `tests/dynamixel/cases` have the form of `tests/kit/cases.py`:

    a servo that lost its power returns without torque
      servos: XM430-W350 11 12, watchdog 10
      servo 11: position_p_gain 700
      3 cycles
      servo 12: power cut for 0.3 s
      100 cycles
      => servo rebooted arm_12_joint: ...
      => torque: 11

The tables at the end of this file have all steps. The robot starts before the first `=>`, at the step
`start`, or before the first step that needs a robot that has started. Each event that is not routine, each
refusal and each answer has its line, in order; `...` stands for any text, and `HELP` for the page "It does
not work".

After a start all servos have torque, and each got a goal before. After a refused start no servo has torque
that had none before, and nothing was written, or a line says that torque was switched off, or what was
written. The ledger of the simulated bus and the simulated servos are the judges.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from tests.kit.cases import TextCase, find_form, fits, read_form
from tests.kit.line_faults import corrupt_next, delay_next, truncate_next, turn_by_hand
from tests.kit.plans import make_plan
from tests.kit.rigs import Rig, every_servo, make_rig, make_x

from dxlrun.channels.cycle import Torque
from dxlrun.dynamixel.servo.torque_off import stand
from dxlrun.errors import StartUpError, help_link
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import ServoConfig
from dxlwire.bus_plan import BusPlan, RegisterValue
from dxlwire.control_table import find_table
from dxlwire.modes import Mode
from dxlwire.plan.reads import slow_items

CASES = Path(__file__).parents[1] / "dynamixel" / "cases"
HELP = help_link("")
ROUTINE = ("setup ", "torque on ", "torque off ", "read lost ", "read back ", "answered")
"""How reports begin that a case may leave out."""

PLANNED: dict[str, tuple[str, Callable[[str], object]]] = {
    "starts in": ("start_mode", lambda value: Mode[value.upper()]),
    "reference": ("reference", lambda value: math.radians(float(value))),
}
"""Options of servos that the plan has under another name."""


@dataclass
class Case:
    """A case of a text, and what came of it."""

    text: TextCase
    plan: BusPlan = field(default_factory=make_plan)
    options: dict[str, Any] = field(default_factory=dict)
    _rig: Rig | None = None
    said: list[str] = field(default_factory=list)
    events: int = 0
    """Events that are in `said`, or were."""
    refused: bool | None = None
    """None before the start."""

    def check(self) -> None:
        """Run the case to its end; an error names the file and the line."""
        for line in self.text.lines:
            try:
                self.follow(line.text)
            except Exception as error:
                rest = "".join(f"\n=> {one}" for one in self.reports())
                raise AssertionError(f"{line.place}: {line.text}: {error}{rest}") from error
        self.begin()
        more = [report for report in self.reports() if not report.startswith(ROUTINE)]
        assert not more, "\n".join([f"{self.text.lines[-1].place}: more was reported:", *more])
        if self.refused and not any(
            "torque" in line.text and " off " in line.text for line in self.text.lines
        ):
            assert not self.rig.writes() or self.has("=> writes"), f"{self.text.place}: a refused start wrote"

    def has(self, beginning: str) -> bool:
        return any(line.text.startswith(beginning) for line in self.text.lines)

    @property
    def rig(self) -> Rig:
        if self._rig is None:
            self._rig = make_rig(self.plan, **self.options)
        return self._rig

    @property
    def ids(self) -> list[int]:
        return [servo.servo_id for servo in self.plan.servos]

    def row(self, servo_id: str) -> int:
        return self.ids.index(int(servo_id))

    def follow(self, line: str) -> None:
        """Do a step, or check an expectation."""
        if not line.startswith("=>"):
            self.do_step(line)
            return
        self.begin()
        if check := find_form(EXPECTATIONS, line[2:].strip()):
            check(self)
        else:
            self.expect_report(line[2:].strip())

    def do_step(self, text: str) -> None:
        if act := find_form(SETUP, text):
            act(self)
            return
        act = read_form(AFTER_START, text)
        self.begin()
        act(self)

    def begin(self) -> None:
        """Start the robot, once."""
        if self.refused is not None:
            return
        rig, self.refused = self.rig, False
        before = rig.torque()
        try:
            rig.hardware.start()
        except StartUpError as error:
            self.refused = True
            self.said += [f"refused: {sentence.replace(HELP, 'HELP ')}" for sentence in error.sentences]
            given = [now and not then for now, then in zip(rig.torque(), before, strict=True)]
            assert not any(given) or "torque off was sent" in self.said[-1], "a servo has torque"
            return
        torque = rig.torque()[: len(self.ids)]
        assert all(torque) or self.has("=> torque"), f"torque after the start: {torque}"
        goals = {one.address for servo in self.plan.servos for mode in servo.modes for one in mode.goals}
        with_goal = set[int]()
        for servo_id, address, data in rig.writes():
            if address in goals:
                with_goal.add(servo_id)
            is_torque = address == self.plan.servos[0].torque_address and data == b"\1"
            assert not is_torque or servo_id in with_goal, f"servo {servo_id} got torque before a goal"

    def reports(self) -> list[str]:
        """Return what was reported and not expected yet."""
        if self._rig is not None:
            new = self._rig.events.list[self.events :]
            self.events += len(new)
            for code, _, source, text in new:
                name = code.name.lower().replace("_", " ")
                self.said.append(f"{name} {source}: {text.replace(HELP, 'HELP ')}")
        return self.said

    def expect_report(self, line: str) -> None:
        """Take the next report, which must be this one; routine ones may come before it."""
        reports = self.reports()
        while reports:
            if fits(reports[0], line):
                reports.pop(0)
                return
            assert reports[0].startswith(ROUTINE), "this was not reported, but:"
            reports.pop(0)
        raise AssertionError("this was not reported")

    def answer(self, problem: str, _found: int | None = None) -> None:
        self.said.append(f"answered: {problem}" if problem else "answered")

    # Steps

    def plan_servos(self, model: str, ids: str, options: str | None) -> None:
        protocol = 1.0 if model[:2] in {"AX", "MX", "RX", "EX"} else 2.0
        make = partial(make_plan, protocol=protocol) if protocol == 1.0 else make_x
        given: dict[str, Any] = {"model": model}
        later: list[Callable[[BusPlan], BusPlan]] = []
        for option in (options or "").split(", "):
            name, _, value = option.rpartition(" ")
            if name in CHANGED_PLANS:
                later.append(CHANGED_PLANS[name](value))
            elif option == "taken over":
                self.options["take_over"] = True
            elif name in {"firmware", "position"}:
                self.options[name] = float(value) if name == "position" else int(value)
            elif option == "continuous":
                given |= {"continuous": True, "lower": -math.inf, "upper": math.inf}
            elif name in PLANNED:
                key, read = PLANNED[name]
                given[key] = read(value)
            elif option:
                lower, upper = option.removeprefix("limits ").split()
                given |= {"lower": float(lower), "upper": float(upper)}
        self.plan = make([int(one) for one in ids.split()], **given)
        for change in later:
            self.plan = change(self.plan)

    def declare(self, servo_id: str, registers: str) -> None:
        """Declare registers of a servo in the robot file, EEPROM first."""
        servos = list(self.plan.servos)
        servo = servos[self.row(servo_id)]
        items = find_table(servo.model, self.plan.protocol).items
        wanted = []
        for name, value in (one.split() for one in registers.split(", ")):
            item = items[name]
            wanted.append(RegisterValue(item.address, item.size, int(value), name, item.area == "EEPROM"))
        servos[self.row(servo_id)] = replace(
            servo, settings=tuple(sorted(wanted, key=lambda one: not one.eeprom))
        )
        self.plan = replace(self.plan, servos=tuple(servos))

    def expect_offset(self, servo_id: str, offset: str) -> None:
        """Let the robot file expect a Homing Offset of a servo, which is then part of its ticks."""
        value = RegisterValue(20, 4, int(offset), "homing_offset", True, False)
        moved = [
            replace(one.moved(int(offset)), homing_offset=int(offset), expected=(value,))
            if one.servo_id == int(servo_id)
            else one
            for one in self.plan.servos
        ]
        self.plan = replace(self.plan, servos=tuple(moved))

    def change_servo(self, servo_id: str, changes: str) -> None:
        for change in changes.split(", "):
            read_form(CHANGES, change)(self, self.rig.servo(int(servo_id)))

    def act_before(
        self, packet: Sequence[str], value: str | None, first: str | None, last: str, step: str
    ) -> None:
        """Do something before each packet that reads or writes an address of a servo, or only some times."""
        least, most = int(first or 1), int(last) if last else math.inf
        count = 0

        def act() -> None:
            nonlocal count
            count += 1
            if least <= count <= most:
                self.do_step(step)

        data = b"" if value is None else bytes((int(value),))
        self.rig.when(partial(is_packet, self.plan.protocol, packet, data), act)

    def change_mode(self, servo_id: str, mode: str) -> None:
        modes = [0] * len(self.ids)
        modes[self.row(servo_id)] = Mode[mode.upper()]
        self.rig.set_modes(*modes)

    def stop(self) -> None:
        self.said += [f"stopped: {sentence}" for sentence in self.rig.hardware.stop()]

    def give_goal(self, servo_id: str, goals: str) -> None:
        """Give a joint these goals, and none of other interfaces."""
        row = self.row(servo_id)
        self.rig.goals.values[:, row] = math.nan
        for interface, goal in (one.split() for one in goals.split(", ")):
            getattr(self.rig.goals, interface)[row] = float(goal)

    def limit_torque(self, share: str, full: str) -> None:
        """Let a policy reduce the torque of all servos."""
        self.rig.hardware._full_torque = [[int(full)] * len(self.ids)]
        self.rig.hardware.limit_torque(float(share))

    def stand(self) -> None:
        """Let the guardian stop the wheels of a loop that died."""
        self.said += [f"stood: {sentence}" for sentence in stand(self.rig.lines)]

    # Expectations

    def expect_place(self, servo_id: str, degrees: str) -> None:
        """Compare the shaft with an angle from raw 0, which friction leaves by some ticks, and the state."""
        servo = self.plan.servos[self.row(servo_id)]
        angle, tick = math.radians(float(degrees)), servo.rad_per_tick
        off = math.remainder(self.rig.servo(int(servo_id)).shaft_angle - angle, math.tau)
        assert abs(off) < 3.6 * tick, f"the shaft is {math.degrees(off):.2f} deg off"
        raw = servo.reference - (servo.homing_offset or 0) * tick
        joint = servo.direction * (angle + off - raw) * servo.ratio
        assert self.rig.states.position[servo.row] == pytest.approx(joint, abs=tick), math.degrees(joint)

    def expect_error(self, servo_id: str, error: str) -> None:
        found = self.rig.states.hardware_error[self.row(servo_id)]
        assert found == int(error), f"it is {found}"

    def expect_turning(self, servo_id: str, turns: str) -> None:
        velocity = self.rig.servo(int(servo_id)).velocity
        assert (abs(velocity) > 0.05) == (turns == "turns"), f"it turns by {velocity:.2f} rad/s"

    def expect_ids(self, found: Sequence[int], ids: str) -> None:
        named = {"all": self.ids, "none": []}
        expected = named[ids] if ids in named else [int(one) for one in ids.split()]
        assert [*found] == expected, f"it is {' '.join(map(str, found)) or 'none'}"

    def expect_flags(self, flags: Sequence[bool], ids: str) -> None:
        self.expect_ids([one for one, flag in zip(self.ids, flags, strict=False) if flag], ids)

    def expect_registers(self, servo_id: str, registers: str) -> None:
        for name, value in (one.split() for one in registers.split(", ")):
            found = self.rig.servo(int(servo_id)).registers.ticks(name)
            assert found == int(value), f"{name} is {found}"

    def expect_mode(self, servo_id: str, mode: str) -> None:
        found = Mode(int(self.rig.states.mode[self.row(servo_id)])).name.lower()
        assert found == mode, f"it is {found}"


def is_packet(protocol: float, packet: Sequence[str], value: bytes, data: bytes) -> bool:
    """Check whether bytes are an instruction (`read` or `write`) to an ID and an address, with this value."""
    kind, servo_id, address = packet
    expected = int(servo_id), {"read": 2, "write": 3}[kind], int(address)
    if protocol == 1.0:
        return (data[2], data[4], data[5]) == expected and data[6:-1].startswith(value)
    return (data[4], data[7], data[8] | data[9] << 8) == expected and data[10:-2].startswith(value)


def limp_at_start(servo_id: int, plan: BusPlan) -> BusPlan:
    """Return a plan in which a servo gets no torque at the start."""
    servos = [
        replace(one, torque_at_start=one.torque_at_start and one.servo_id != servo_id) for one in plan.servos
    ]
    return replace(plan, servos=tuple(servos))


def read_slowly(item: str, plan: BusPlan) -> BusPlan:
    """Return a plan that reads an item, or `all` that is measured, once a second in idle time."""
    table = find_table(plan.servos[0].model, plan.protocol)
    slow = slow_items(table) if item == "all" else (item,)
    return every_servo(replace(plan, slow_period_ns=1_000_000_000), slow=slow)


CHANGED_PLANS: dict[str, Callable[[str], Callable[[BusPlan], BusPlan]]] = {
    "watchdog": lambda ticks: partial(replace, watchdog_ticks=int(ticks)),
    "port": lambda port: partial(replace, port=port),
    "torque on": lambda _: partial(every_servo, torque_on_return=True),  # `torque on return`
    "slow": lambda item: partial(read_slowly, item),
    "limp": lambda servo_id: partial(limp_at_start, int(servo_id)),
}


def turn_beyond(case: Case, servo: SimulatedServo, ticks: str, side: str) -> None:
    plan = case.plan.servos[case.row(str(servo.servo_id))]
    tick = plan.upper_tick + int(ticks) if side == "above" else plan.lower_tick - int(ticks)
    turn_by_hand(servo, tick * plan.rad_per_tick)


def poke(_case: Case, servo: SimulatedServo, name: str, value: str) -> None:
    assert name in servo.registers.table.items, "no such change or register"
    servo.poke(name, int(value))


SETUP: dict[str, Callable[..., object]] = {
    r"servos: (\S+) ([\d ]+)(?:, (.+))?": Case.plan_servos,
    r"declared (\d+): (.+)": Case.declare,
    r"expected (\d+): homing_offset (-?\d+)": Case.expect_offset,
    r"another: (\S+) (\d+)": lambda case, model, servo_id: case.options.update(
        extra=(ServoConfig(int(servo_id), model, 0.7, 440_000),)
    ),
    r"servo (\d+): (.+)": Case.change_servo,
    # `before write 13 64 = 1 times 2-4: ...`: torque on of servo 13, for the second to fourth time
    r"before (read|write) (\d+) (\d+)(?: = (\d+))?(?: times (\d+)-(\d*))?: (.+)": (
        lambda case, *found: case.act_before(found[:3], *found[3:])
    ),
    r"bus echoes": lambda case: setattr(case.rig.buses[0]._line, "echo", 1),
    r"start": Case.begin,
}
AFTER_START: dict[str, Callable[..., object]] = {
    r"(\d+) cycles?": lambda case, count: case.rig.cycles(int(count)),
    r"(\d+) Hz": lambda case, rate: setattr(case.rig, "period_ns", 1_000_000_000 // int(rate)),
    r"without the loop for (\S+) s": lambda case, seconds: case.rig.wait(round(float(seconds) * 1e9)),
    r"goals sway": lambda case: setattr(case.rig, "restless", 0.006),
    r"torque (on|off) (\d+)": lambda case, on, servo_id: case.rig.hardware.switch_torque(
        case.row(servo_id), on == "on", case.answer
    ),
    r"reboot (\d+)": lambda case, servo_id: case.rig.hardware.reboot_servo(case.row(servo_id), case.answer),
    r"register (\d+): (\w+) (-?\d+)": lambda case, servo_id, name, value: case.rig.hardware.write_register(
        case.row(servo_id), name, int(value), case.answer
    ),
    r"mode (\d+): (\w+)": Case.change_mode,
    r"goal (\d+): (.+)": Case.give_goal,
    r"torque limited to (\S+) of (\d+)": Case.limit_torque,
    r"the loop dies": Case.stand,
    r"left with its torque on": lambda case: case.rig.hardware.leave_torque_on(),
    r"bus unplugged": lambda case: case.rig.buses[0].unplug(),
    r"bus plugged in": lambda case: case.rig.buses[0].plug_in(),
    r"stop": Case.stop,
}
CHANGES: dict[str, Callable[..., object]] = {
    r"silent": lambda _, servo: servo.silence(),
    r"answers": lambda _, servo: servo.silence(False),
    r"reboots": lambda _, servo: servo.power_cycle(),
    r"overload": lambda _, servo: servo.trigger_overload(),
    r"temperature (\S+)": lambda _, servo, value: servo.set_temperature(float(value)),
    r"voltage (\S+)": lambda _, servo, value: servo.set_voltage(float(value)),
    r"power cut for (\S+) s": lambda case, servo, time: servo.cut_power(
        case.rig.clock.now_ns() + round(float(time) * 1e9)
    ),
    r"turned (\d+) ticks (above|below) its limits": turn_beyond,
    r"turned by (\S+) rad": lambda _, servo, angle: turn_by_hand(servo, servo.shaft_angle + float(angle)),
    r"turned to (\S+) deg": lambda _, servo, angle: turn_by_hand(servo, math.radians(float(angle))),
    # from raw 0, as it is after its power was off
    r"placed at (\S+) deg": lambda _, servo, angle: (
        turn_by_hand(servo, math.radians(float(angle))),
        servo.power_cycle(),
    ),
    r"reply lost": lambda case, servo: truncate_next(case.rig.buses[0], servo.servo_id, 0),
    r"reply cut": lambda case, servo: truncate_next(case.rig.buses[0], servo.servo_id, 5),
    r"reply corrupted": lambda case, servo: corrupt_next(case.rig.buses[0], servo.servo_id),
    r"reply doubled": lambda case, servo: case.rig.buses[0].alter_next(servo.servo_id, "2", bytes, copies=2),
    r"reply late by (\S+) ms": lambda case, servo, time: delay_next(
        case.rig.buses[0], servo.servo_id, round(float(time) * 1e6)
    ),
    r"write lost": lambda case, _: case.rig.buses[0].alter_next_instruction("lost", lambda _: b""),
    r"refuses reads of (\w+)": lambda _, servo, name: servo.refuse_reads(
        servo.registers.table.items[name].address
    ),
    r"boots in (\S+) s": lambda _, servo, time: setattr(servo, "boot_ns", round(float(time) * 1e9)),
    r"keeps (\w+) (-?\d+)": lambda case, servo, name, value: case.rig.stick(servo.servo_id, name, int(value)),
    r"(\w+) (-?\d+)": poke,
}
EXPECTATIONS: dict[str, Callable[..., object]] = {
    r"torque: (.+)": lambda case, ids: case.expect_flags(case.rig.torque(), ids),
    r"valid: (.+)": lambda case, ids: case.expect_flags(case.rig.states.valid, ids),
    r"released: (.+)": lambda case, ids: case.expect_flags(case.rig.states.torque == Torque.RELEASED, ids),
    r"goals: (.+)": lambda case, ids: case.expect_ids(case.rig.goals_sent()[-1][1], ids),
    r"servo (\d+): (.+)": Case.expect_registers,
    r"writes (\d+): (.+)": lambda case, servo_id, addresses: case.expect_ids(
        [address for one, address, _ in case.rig.writes() if one == int(servo_id)], addresses
    ),
    r"wrote (\d+) (\d+): (.+)": lambda case, servo_id, address, values: case.expect_ids(
        [
            int.from_bytes(data, "little")
            for *written, data in case.rig.writes()
            if written == [int(servo_id), int(address)]
        ],
        values,
    ),
    r"mode (\d+): (\w+)": Case.expect_mode,
    r"(\d+) is at (\S+) deg": Case.expect_place,
    r"error (\d+): (\d+)": Case.expect_error,
    r"(\d+) (stands|turns)": Case.expect_turning,
}
