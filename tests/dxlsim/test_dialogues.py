"""A host talks to simulated servos, line by line: the texts in `dialogues`.

    A goal wakes a limp servo [AX-12A | RX-28 1 2 position=1]    # title and servos; once with each model
      goal_position = 700; wait 2 s  # write an item of servo 1; `led@2 = 1` of servo 2
      led = 2 => range               # the servo refuses it with this error; `silence`: nothing answers
      check present_position == 700 +- 2       # items are read over the line; {led} is read in the servo
      ask 1 read 24 02 => 1 ok 00 04           # an instruction, and all statuses that answer it
      ask all sync_read 8400 0400 0102 => 1 ok .., 2 alert ..    # `..`: any data; `bytes`: anything
      > ff ff 01 02 01 fb => ff ff 01 02 00 fc   # bytes
      fault lose servo=1
      note collision                           # the ledger has a note with this text

`gravity=0.5@0.43` (Nm, and where the link hangs), `friction`, `delay_us` (of replies), `response_ms` (of
goals) and other words describe the servos. `fault ... => TEXT` is refused with a text. `let NAME =
EXPRESSION`, `poke ITEM = EXPRESSION`, `device ID MODEL`, `hand ANGLE`, `temperature@2`, `voltage`,
`overload`, `power cycle`, `mute`, `sleepy` (no goal wakes it), `absent slot`, `rate`, `unread ITEM` and `no
note` explain themselves. Expressions have the functions of `math`; of servo 1 `angle` and `speed` (rad),
`tick` and `speed_tick` (rad and rad/s of one), `motor` and `memory` (its registers); `clock` and `last_s`
(s; of the newest reply), and `received` (bytes of the newest answers).
"""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from tests.kit.cases import Line as CaseLine
from tests.kit.cases import place_of, read_cases
from tests.kit.line_faults import turn_by_hand
from tests.kit.simulated_line import Answer, Line, split_statuses

from dxlsim.motion.motor import motor_of
from dxlsim.simulation_plan import DeviceConfig, Load
from dxlwire.exceptions import InputError

INSTRUCTIONS = {
    "ping": 1, "read": 2, "write": 3, "reg_write": 4, "action": 5, "reset": 6, "reboot": 8, "clear": 0x10,
    "backup": 0x20, "sync_write": 0x83, "sync_read": 0x82, "fast_sync_read": 0x8A, "bulk_read": 0x92,
    "bulk_write": 0x93, "fast_bulk_read": 0x9A,
}  # fmt: skip
ERRORS = {
    1.0: {"ok": 0, "voltage": 1, "angle": 2, "heat": 4, "range": 8, "cells": 8, "read-only": 8, "damaged": 16,
          "overload": 32, "unknown": 64},
    2.0: {"ok": 0, "failed": 1, "unknown": 2, "damaged": 3, "range": 4, "length": 5, "limit": 6, "access": 7,
          "cells": 7, "read-only": 7, "alert": 0x80},
}  # fmt: skip
"""e-Manual, Protocol 1.0 and 2.0, section "Error"."""
COMMENT = re.compile(r"\s+#( .*|$)")
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}


class Values(dict[str, Any]):
    """Names of an expression: constants, what a case remembers, what is read of a servo."""

    def __init__(self, line: Line) -> None:
        super().__init__(
            vars(math) | {"abs": abs, "len": len, "min": min, "max": max, "round": round, "sum": sum}
        )
        self.line, self.received = line, b""

    def item(self, name: str, servo_id: int) -> int:
        return self.line.get(name, servo_id)

    def register(self, name: str, servo_id: int) -> int:
        return self.line.servo(servo_id).registers[name]

    def __missing__(self, name: str) -> Any:
        servo = self.line.servo()
        table = servo.registers.table
        known = {
            "angle": lambda: servo.shaft_angle,
            "speed": lambda: servo.velocity,
            "tick": lambda: table.rad_per_tick,
            "speed_tick": lambda: table.rad_s_per_tick,
            "max_speed": lambda: table.max_speed,
            "torque_on": lambda: servo.torque_on,
            "motor": lambda: motor_of(table),
            "clock": lambda: self.line.clock.now_ns() / 1e9,
            "last_s": lambda: (
                next(e.t_ns for e in reversed(self.line.ledger.entries) if e.direction == "out") / 1e9
            ),
            "received": lambda: self.received,
            "faults": lambda: self.line.faults,
            "fault_times": lambda: [e.t_ns / 1e9 for e in self.line.ledger.entries if "fault: " in e.note],
            "address_of": lambda: lambda item: self.line.item(item).address,
            "memory": lambda: bytes(servo.registers.image)[:-30],
        }
        return known[name]() if name in known else self.line.get(name)

    def of(self, expression: str) -> Any:
        text = re.sub(r"\{(\w+)(?:@(\d+))?\}", lambda m: f"register('{m[1]}', {m[2] or 1})", expression)
        text = re.sub(r"(\w+)@(\d+)", r"item('\1', \2)", text)
        self |= {"item": self.item, "register": self.register}
        return eval(text, {"__builtins__": {}}, self)  # noqa: S307  our own texts


class Dialogue:
    """A case that runs."""

    def __init__(self, model: str, words: list[str]) -> None:
        given = dict(word.split("=", 1) for word in words if "=" in word)
        load = Load(friction=float(given.pop("friction", 0)), inertia=float(given.pop("inertia", 0)))
        if "gravity" in given:
            pull, _, angle = given.pop("gravity").partition("@")
            load = Load(load.inertia, load.friction, float(pull), float(angle))
        settings: dict[str, Any] = {"load": load}
        for key, value in given.items():
            if key == "delay_us":
                settings["return_delay_ns"] = int(value) * 1000
            elif key == "response_ms":
                settings["response_delay_ns"] = int(value) * 1_000_000
            else:
                settings[key] = float(value) if key == "position" else int(value)
        if model.endswith("(2.0)"):
            settings["protocol"] = 2.0
        ids = [int(word) for word in words if "=" not in word]
        self.line = Line(model.removesuffix("(2.0)"), *ids, **settings)
        self.values = Values(self.line)

    def error(self, words: str) -> int:
        return sum(ERRORS[self.line.protocol][word] for word in words.split("+"))

    def expect_statuses(self, told: str) -> None:
        wait_ns = 1_000_000_000 if told.endswith(" slowly") else 10_000_000
        self.values.received = self.line.receive(wait_ns)
        if told == "bytes":
            return
        fast = self.values.received[4:5] == b"\xfe"  # one status of all, whose parts are not stuffed
        parts = [Answer(254, self.values.received[8], b"")] if fast else []
        found = parts or split_statuses(self.values.received, self.line.protocol)
        wanted = [one.split(maxsplit=2) for one in told.removesuffix(" slowly").split(",") if one.strip()]
        said = [f"{one.servo_id} {one.error:#x} {one.parameters.hex()}" for one in found]
        assert len(found) == len(wanted), said
        for answer, (servo_id, error, *data) in zip(found, wanted, strict=True):
            assert (answer.servo_id, answer.error) == (int(servo_id), self.error(error)), said
            if data != [".."]:
                assert answer.parameters == bytes.fromhex("".join(data)), said

    def write(self, name: str, servo_id: int, value: int, told: str) -> None:
        if told == "silence":
            with pytest.raises(AssertionError):
                self.line.set(name, value, servo_id)
            return
        error = self.line.set(name, value, servo_id)
        assert error == self.error(told), f"error {error:#x}"

    def expect_silence(self, name: str) -> None:
        with pytest.raises(AssertionError):
            self.line.get(name)

    def check(self, condition: str) -> None:
        equal = re.fullmatch(r"(.+?) == (.+?) \+- (.+?)( %)?", condition)
        if equal is None:
            sides = [self.values.of(side) for side in condition.split(" == ")]
            assert sides[0] == sides[1] if sides[1:] else sides[0], sides
            return
        found, wanted, off = (self.values.of(equal[n]) for n in (1, 2, 3))
        assert found == pytest.approx(wanted, abs=abs(wanted) * off / 100 if equal[4] else off)

    def step(self, text: str) -> None:
        line, values = self.line, self.values
        command, _, rest = text.partition(" ")
        what, _, answer = rest.partition("=> ")
        if written := re.fullmatch(r"(\w+)(?:@(\d+))? = (.+?)(?: => (\S+))?", text):
            self.write(written[1], int(written[2] or 1), values.of(written[3]), written[4] or "ok")
        elif command == "ask":
            servo_id, name, *data = what.split()
            line.instruct(
                254 if servo_id == "all" else int(servo_id),
                INSTRUCTIONS[name] if name in INSTRUCTIONS else int(name, 16),
                bytes.fromhex("".join(data)),
            )
            self.expect_statuses(answer)
        elif command == ">":
            if what:
                line.send(bytes.fromhex(what))
            values.received = line.receive(20_000_000)
            assert answer == ".." or values.received == bytes.fromhex(answer), values.received.hex(" ")
        elif command == "let":
            names, _, expression = rest.partition(" = ")
            value = values.of(expression)
            values |= zip(names[1:-1].split(", "), value, strict=True) if names[0] == "(" else {names: value}
        elif command == "poke":
            name, _, expression = rest.partition(" = ")
            item, _, servo_id = name.partition("@")
            line.servo(int(servo_id or 1)).poke(item, values.of(expression))
        elif command == "wait":
            number, unit = rest.split()
            line.wait(float(number) * UNITS[unit])
        elif command == "no":
            assert not any(rest.removeprefix("note ") in note for note in line.notes), line.notes
        elif command == "note":
            assert any(rest in note for note in line.notes), line.notes
        elif command == "check":
            self.check(rest)
        elif command == "fault" and answer:
            with pytest.raises(InputError, match=re.escape(answer)):
                line.inject(what)
        else:
            self.change(command, rest)

    def change(self, command: str, rest: str) -> None:
        """Change what is on the line, or its state."""
        line, values = self.line, self.values
        command, _, servo_id = command.partition("@")
        servo = line.servo(int(servo_id or 1))
        changes = {
            "fault": lambda: line.inject(*rest.split(" & ")),
            "device": lambda: line.bus.add_device(
                DeviceConfig(int(rest.split(maxsplit=1)[0]), rest.split()[1])
            ),
            "hand": lambda: turn_by_hand(servo, values.of(rest)),
            "temperature": lambda: servo.set_temperature(values.of(rest)),
            "voltage": lambda: servo.set_voltage(values.of(rest)),
            "overload": servo.trigger_overload,
            "excuse": lambda: line.bus.excuse(int(rest.split(maxsplit=1)[0]) * 1_000_000),
            "power": servo.power_cycle,
            "sleepy": lambda: setattr(servo, "wakes_on_goal", False),
            "mute": servo.silence,
            "unmute": lambda: servo.silence(False),
            "absent": lambda: setattr(line.bus, "absent", rest),
            "unread": lambda: self.expect_silence(rest),
            "rate": lambda: setattr(line.bus, "baud_rate", int(rest)),
        }
        changes[command]()


class Case(NamedTuple):
    model: str
    words: list[str]
    steps: list[CaseLine]

    def run(self) -> None:
        dialogue = Dialogue(self.model, self.words)
        for step in self.steps:
            with place_of(step):
                dialogue.step(step.text)


def cases() -> Iterator[Any]:
    """Yield the cases of all texts: with each of their models."""
    for text in read_cases(Path(__file__).with_name("dialogues")):
        title = re.fullmatch(r"(.+) \[(.+)\]", COMMENT.sub("", text.name))
        assert title, f"{text.place}: a title ends with its servos, such as [AX-12A 1 2]"
        words = title[2].split()
        models = [word for word in words if re.search("[A-Z]", word) and "=" not in word]
        words = [word for word in words if word not in (*models, "|")]
        steps = [
            CaseLine(line.place, step)
            for line in text.lines
            for step in COMMENT.sub("", line.text).strip().split("; ")
        ]
        for model in models:
            name = f"{text.place}: {title[1]}" + (f" [{model}]" if models[1:] else "")
            yield pytest.param(Case(model, words, steps), id=name)


@pytest.mark.parametrize("case", [*cases()])
def test_dialogue(case: Case) -> None:
    case.run()
