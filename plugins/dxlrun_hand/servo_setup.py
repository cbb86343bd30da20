"""`dxlrun setup`: each new servo is connected alone and configured; then all are compared with the file."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from dxlrun import PortError, ServoFault
from dxlrun.tooling.output import choose_remedy
from dxlrun.tooling.robots import Description, compile_robot, find_unknown_servos
from dxlrun.tooling.servos import (
    FoundServo,
    OneServo,
    Search,
    ToolLine,
    compare_servos,
    scan,
    stored_registers,
)
from dxlrun_hand.dialogue import Dialogue, yes
from dxlrun_hand.lines import BusLines
from dxlwire import BusPlan, ControlTable, ServoPlan, find_table

SKIP = ("s", "skip")


class ServoSetup:
    """Dialogue that configures the servos of a robot file; `done` lists the names of the finished ones."""

    def __init__(self, description: Description, dialogue: Dialogue) -> None:
        self.description = description
        self.dialogue = dialogue
        self._unknown = find_unknown_servos(description)
        self._models: dict[str, str] = {}
        self.plans: Sequence[BusPlan] = compile_robot(description, []).plan.buses
        self.done: list[str] = []
        self.changing = ""
        """Name of the servo that is being written to; empty between two servos."""

    def connect_each(self, lines: BusLines, chosen: Collection[str]) -> None:
        """Ask the user to connect each chosen servo alone, and write its settings; servos can be skipped."""
        for index, plan in enumerate(self.plans):
            for servo in plan.servos:
                if servo.own_name in chosen and self._set_up(lines, index, servo.own_name):
                    self.done.append(servo.own_name)

    def compare_all(self, lines: BusLines, chosen: Collection[str]) -> bool:
        """Ask the user to connect all servos, read the chosen ones back, and print deviations.

        Returns True if all match the robot file, or False once the user declines to repeat the comparison.
        """
        for plan in self.plans:
            servos = tuple(servo for servo in plan.servos if servo.own_name in chosen)
            while servos:
                self.dialogue.ask_question(
                    f"Connect all servos of bus {plan.name} with their power, and press Enter "
                )
                with lines.open_line(plan.name) as tool:
                    found = compare_servos(tool, plan, servos)
                self.dialogue.print_lines(
                    *(f"{joint}: {text}" for joint, text in found.describe_deviations())
                )
                if not found.problems:
                    count = "1 servo matches" if len(servos) == 1 else f"{len(servos)} servos match"
                    self.dialogue.print_lines(f"Bus {plan.name}: {count} the robot file.")
                    break
                self.dialogue.print_lines(*found.problems)
                if not yes(self.dialogue, "Compare again?"):
                    return False
        return True

    def _set_up(self, lines: BusLines, index: int, name: str) -> bool:
        """Set up the servo `name` of a bus, again after errors; return False if the user skipped it."""
        while True:
            plan = self.plans[index]
            servo = _named(plan, name)
            model = "any model" if name in self._unknown else servo.model
            typed = self.dialogue.ask_question(
                f"Connect the servo for {name} ({model}) alone to bus {plan.name}, and press Enter "
                "(s: skip it) "
            )
            if typed.lower() in SKIP:
                return False
            try:
                with lines.open_line(plan.name) as tool:
                    found = self._alone(tool, plan, servo)
                    if not self._is_another(plan, found):
                        continue
                    if name in self._unknown:
                        self._models[name] = found.model
                        self.plans = compile_robot(self.description, [], models=self._models).plan.buses
                        plan = self.plans[index]
                    self.changing = name
                    one, servo = OneServo(tool, found), _named(plan, name)
                    for sentence in (*bring(one, plan, servo), *self._clear_offset(one, servo)):
                        self.dialogue.print_lines(f"  {name}: {sentence}")
            except (PortError, ServoFault) as error:
                self.dialogue.print_lines(*error.sentences)
                continue
            self.changing = ""
            return True

    def _is_another(self, plan: BusPlan, found: FoundServo) -> bool:
        """Return False if a servo was set up before, and the user forgot to exchange it for the next one.

        Only the user knows: a new servo may have the ID and the rate of one that is set up.
        """
        before = (servo for servo in plan.servos if servo.own_name in self.done)
        names = [servo.own_name for servo in before if servo.servo_id == found.servo_id]
        if not names or found.baud_rate != plan.baud_rate:
            return True
        what = f"ID {found.servo_id} is that of {names[0]}, which was set up before. Is this another servo?"
        return yes(self.dialogue, what)

    def _clear_offset(self, one: OneServo, servo: ServoPlan) -> list[str]:
        """Write Homing Offset 0 if the user agrees; the robot file of `servo` does not mention the offset."""
        item = one.table.items.get("homing_offset")
        if item is None or servo.homing_offset is not None:
            return []
        offset = one.read_items([item.name])[item.name]
        what = f"{item.title} is {offset}, from another program. Runs take it into account. Write 0?"
        if not offset or not yes(self.dialogue, what):
            return []
        return [*one.write_registers((one.register(item.name, 0),))]

    def _alone(self, tool: ToolLine, plan: BusPlan, servo: ServoPlan) -> FoundServo:
        """Search a bus for the only servo that answers, at its usual baud rates first, then at all.

        Raises:
            ServoFault: No servo answers, several do, or one of another protocol or model than `servo` does.
        """
        table = find_table(servo.model, plan.protocol)
        rates = dict.fromkeys((plan.baud_rate, factory_rate(table)))
        found = scan(tool, Search((plan.protocol,), tuple(rates))).servos
        if not found:
            self.dialogue.print_lines(
                "  no servo at the usual baud rates; trying all others for half a minute"
            )
            found = scan(tool).servos
        if not found:
            remedy = choose_remedy(tool.port.name, "check its power and its cable")
            raise ServoFault(f"No servo answers at {tool.port.name}; {remedy}.")
        one = found[0]
        if len(found) > 1 or one.garbled:
            shown = ", ".join(f"ID {each.servo_id} at {each.baud_rate} bit/s" for each in found)
            if len(found) > 1:
                raise ServoFault(f"Several servos answer ({shown}); nothing was changed. Connect only one.")
            raise ServoFault(f"Two servos with the same ID seem to answer ({shown}); connect only one.")
        if one.protocol != plan.protocol:
            raise ServoFault(
                f"The servo uses Protocol {one.protocol}, and bus {plan.name} Protocol {plan.protocol}; "
                "connect another servo, or change its firmware with DYNAMIXEL Wizard."
            )
        if (
            one.device
            or not one.model
            or (servo.own_name not in self._unknown and servo.model not in one.models)
        ):
            called = one.model or f"model number {one.model_number}"
            wanted = "a servo" if servo.own_name in self._unknown else servo.model
            raise ServoFault(
                f"ID {one.servo_id} is {called}, but {servo.own_name} needs {wanted} in the robot file; "
                "connect another servo, or correct the file."
            )
        return one


def factory_rate(table: ControlTable) -> int:
    """Return the factory default baud rate of a model, bit/s."""
    item = table.items.get("baud_rate") or table.items["baud_rate_bus"]
    return table.baud_rates.get(item.initial or 0, next(iter(table.baud_rates.values())))


def bring(one: OneServo, plan: BusPlan, servo: ServoPlan) -> list[str]:
    """Bring the settings of a connected servo to those of the robot file; return a sentence for each change.

    Torque is switched off; baud rate, ID and EEPROM registers are written. Settings that would prevent a run,
    such as a Secondary ID, are reset to factory defaults.

    Raises:
        ServoFault: The model lacks the baud rate, or the servo does not accept a change.
    """
    done: list[str] = []
    if one.holds_torque():
        done += one.torque(False)
    if one.baud_rate != plan.baud_rate:
        if plan.baud_rate not in one.table.baud_rates.values():
            raise ServoFault(
                f"{one.table.model} does not support {plan.baud_rate} bit/s; correct the robot file"
            )
        done.append(one.change_rate(plan.baud_rate))
    if one.servo_id != servo.servo_id:
        done.append(one.change_id(servo.servo_id))
    desired = stored_registers(one.table, plan, servo)
    declared = {register.name for register in desired}
    refusing = (item for item in one.table.items.values() if item.deviation and item.deviation.may_refuse)
    names = [item.name for item in refusing if item.area == "EEPROM"]
    for each in one.deviations(one.read_items(names, refused=True)):
        if each.refused and each.item.name not in declared:
            desired = (*desired, one.register(each.item.name, each.factory))
    done += one.write_registers(desired)
    return done or ["already matches the robot file"]


def _named(plan: BusPlan, name: str) -> ServoPlan:
    return next(servo for servo in plan.servos if servo.own_name == name)
