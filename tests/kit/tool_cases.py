"""Cases of `dxlrun servo` and `dxlrun scan` as text, in `tests/dynamixel/tool_cases`; see `servo_cases.py`.

A case begins with `tool:` or `line:`. What a step did or found has a line `=> done: ...`, and what was
refused `=> refused: ...`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import pytest
from tests.kit.cases import find_form, read_form
from tests.kit.rigs import VirtualLine
from tests.kit.servo_cases import Case

from dxlrun.cli.tools.servo import VERBS, VerbCall
from dxlrun.dynamixel.tools.one_servo import OneServo
from dxlrun.dynamixel.tools.scanning import FoundServo, Search, find_servo, scan
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import DxlrunError
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import AdapterConfig, ServoConfig
from dxlwire.transaction import BROADCAST_ID
from dxlwire.wire.protocol2 import Reset

RATE = 57_600
PING, READ, WRITE, FACTORY_RESET = 1, 2, 3, 6


class ToolRig:
    """One servo with ID 1 to deal with, and perhaps others on its line."""

    def __init__(
        self, model: str, others: Iterable[int] = (), cannot: Iterable[int] = (), protocol: float = 0.0
    ) -> None:
        ids = [1, *others]
        servos = (ServoConfig(each, model, 1.5 if number else 2.0) for number, each in enumerate(ids))
        protocol = protocol or (1.0 if model[:2] in {"AX", "MX"} else 2.0)
        self.line = VirtualLine(*servos, protocol=protocol, cannot=tuple(cannot))
        self.clock, self.buses = self.line.clock, [self.line.bus]
        (found,) = find_servo(tool := ToolLine(self.line), 1, Search((protocol,), (RATE,)))
        self.one = OneServo(tool, found)
        self.start = len(self.line.heard)

    def servo(self, number: int) -> SimulatedServo:
        """Return the servo that had an ID at first: 1, or the second one."""
        self.line.bus.advance_to(self.clock.now_ns())
        return self.line.bus.servos[number - 1]

    def stick(self, number: int, name: str, value: int) -> None:
        servo = self.servo(number)
        servo.registers.watch_items((name,), lambda: servo.poke(name, value))

    def wait(self, seconds: float) -> None:
        self.clock.wait_until(self.clock.now_ns() + round(seconds * 1e9))

    def sent(self) -> list[int]:
        """Return the instructions that were sent since the servo was found."""
        return [data[7] if data[2] == 0xFD else data[4] for data in self.line.heard[self.start :]]


class ScanRig(ToolRig):
    """Servos on a line on which somebody looks for them."""

    def __init__(self, line: VirtualLine) -> None:
        self.line, self.clock, self.buses, self.start = line, line.clock, [line.bus], 0


@dataclass
class ToolCase(Case):
    refused: bool | None = False
    tool: ToolRig = field(init=False)

    @property
    def rig(self) -> ToolRig:  # type: ignore[override]  # it has what the changes of servos use
        return self.tool

    def begin(self) -> None:
        pass

    def follow(self, line: str) -> None:
        if not line.startswith("=>"):
            read_form(STEPS, line)(self)
        elif check := find_form(EXPECTATIONS, line[2:].strip()):
            check(self)
        else:
            self.expect_report(line[2:].strip())

    def do(self, act: Callable[[], object]) -> None:
        """Do something with the servo; report what was done, or why it was refused."""
        try:
            done = act()
        except DxlrunError as error:
            self.said += [f"refused: {sentence}" for sentence in error.sentences]
            return
        self.said += [f"done: {one}" for one in ([done] if isinstance(done, str | int) else done or [])]

    def open_tool(self, model: str, kind: str | None, numbers: str | None) -> None:
        given = {"others": "others", "adapter without": "cannot"}
        more = {given[kind]: [int(one) for one in (numbers or "").split()]} if kind else {}
        self.do(lambda: setattr(self, "tool", ToolRig(model, **more)))

    def open_line(self, servos: str, rate: str, kind: str | None, value: str | None) -> None:
        listed = [(model, each) for model, *ids in map(str.split, servos.split(", ")) for each in ids]
        configs = [ServoConfig(int(each), model, 2.0) for model, each in listed]
        more: dict[str, Any] = {"protocol": 1.0 if servos[:2] in {"AX", "MX"} else 2.0, "rate": int(rate)}
        if kind == "without":
            more["cannot"] = tuple(map(int, (value or "").split()))
        elif kind:
            timer_ns = round(float(value or 0) * 1e6)
            more["adapter"] = AdapterConfig(latency_timer_ns=timer_ns, echo=kind == "that echoes")
        self.tool = ScanRig(VirtualLine(*configs, **more))

    def scan(self, ids: str | None, everywhere: str | None) -> None:
        """Look for servos at the rate that the line has, or at all rates of its protocol."""
        bus = self.tool.line.bus
        rates = () if everywhere else (bus.baud_rate,)
        search = Search((bus.protocol,), rates, tuple(map(int, (ids or "").split())))

        def look() -> list[str]:
            result = scan(ToolLine(self.tool.line), search)
            left_out = [f"no rate of the adapter: {rate}" for rate in result.left_out]
            return [*map(described, result.servos), *left_out]

        self.do(look)

    def write(self, registers: str) -> None:
        wanted = [one.split() for one in registers.split(", ")]
        one = self.tool.one
        self.do(lambda: one.write_registers([one.register(name, int(value)) for name, value in wanted]))

    def set_register(self, name: str, value: str) -> None:
        self.do(lambda: [*VERBS["set"].do(self.tool.one, VerbCall((name, value), None, yes=False))])

    def lose_instruction(self, number: str) -> None:
        bus = self.tool.line.bus
        bus.after(int(number) - 1, partial(bus.alter_next_instruction, "lost", lambda _: b""))

    def expect_sent(self, count: str, kind: str) -> None:
        if kind == "broadcast":
            found = sum(data[4] == BROADCAST_ID for data in self.tool.line.heard)
        else:
            found = self.tool.sent().count(WRITE if kind == "write" else FACTORY_RESET)
        assert found == (0 if count == "no" else int(count)), f"it is {found}"

    def expect_rest(self, angle: str, torque: str) -> None:
        self.tool.wait(1)
        servo = self.tool.servo(1)
        assert servo.shaft_angle == pytest.approx(float(angle), abs=0.005)
        assert servo.torque_on == (torque == "with")


def described(found: FoundServo) -> str:
    where = f"ID {found.servo_id} at {found.baud_rate} bit/s"
    return "; ".join((f"{where}: {found.model or 'unknown'}", *found.remarks))


STEPS: dict[str, Callable[..., object]] = {
    r"tool: (\S+)(?:, (others|adapter without) (.+))?": ToolCase.open_tool,
    r"line: (.+?) at (\d+)(?:, adapter (without|that echoes|of)(?: ([\d ]+?)(?: ms)?)?)?": ToolCase.open_line,
    r"line unplugged": lambda case: case.tool.line.ports.ports[0].unplug(),
    r"scan(?: ([\d ]+))?( at all rates)?": ToolCase.scan,
    r"find (\d+) everywhere": lambda case, servo_id: case.do(
        lambda: map(described, find_servo(ToolLine(case.tool.line), int(servo_id)))
    ),
    r"servo (\d+): (.+)": Case.change_servo,
    r"instruction (\d+) lost": ToolCase.lose_instruction,
    r"(\d+) s": lambda case, time: case.tool.wait(float(time)),
    r"change id (\d+)": lambda case, new: case.do(lambda: case.tool.one.change_id(int(new))),
    r"change rate (\d+)": lambda case, rate: case.do(lambda: case.tool.one.change_rate(int(rate))),
    r"write (.+)": ToolCase.write,
    r"set (\w+) (-?\d+)": ToolCase.set_register,
    r"read (\w+)": lambda case, name: case.do(lambda: case.tool.one.read_items([name])[name]),
    r"torque (on|off)": lambda case, on: case.do(lambda: case.tool.one.torque(on == "on")),
    r"reboot": lambda case: case.do(case.tool.one.reboot),
    r"back up": lambda case: case.do(case.tool.one.back_up),
    r"restore": lambda case: case.do(case.tool.one.take_back),
    r"blink (\d+)": lambda case, times: case.do(lambda: case.tool.one.blink(int(times))),
    r"factory reset (\w+)": lambda case, keep: case.do(
        lambda: case.tool.one.factory_reset(Reset[keep.upper()])
    ),
}
EXPECTATIONS: dict[str, Callable[..., object]] = {
    r"servo (\d+): (.+)": Case.expect_registers,
    r"sent: (no|\d+) (write|reset|broadcast)s?": ToolCase.expect_sent,
    r"sent: (pings and )?reads alone": lambda case, pings: case.expect_ids(
        sorted({*case.tool.sent()}), f"{PING} {READ}" if pings else str(READ)
    ),
    r"stays at (\S+) rad (with|without) torque": ToolCase.expect_rest,
}
