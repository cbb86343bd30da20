"""Safe values of devices: what their commands become at the end of a run, whichever process ends it.

Needs neither numpy nor the loop: the guardian writes them after the loop died.
"""

from __future__ import annotations

from dxlrun.dynamixel.bus_part import SafeStage
from dxlrun.features.devices.plan import DevicesPlan, decode_devices
from dxlwire.bus_plan import BusPlan
from dxlwire.exchange.bus import Lines
from dxlwire.plan.retry import limit_patience, retry, setup_line
from dxlwire.transaction import Outcome, Program


def write_safe_values(lines: Lines, plan: bytes) -> tuple[str, ...]:
    """Write the safe value of every command that has one; return a sentence for each that failed.

    Raises nothing. A line without devices gets no byte.
    """
    commands = decode_devices(plan)
    if not any(commands.get(device.name) for bus in lines.plans for device in bus.devices):
        return ()
    found = lines.run([limit_patience(_write_safe_values(bus, commands)) for bus in lines.plans])
    return tuple(problem for problems in found for problem in problems or ())


def _write_safe_values(plan: BusPlan, commands: DevicesPlan) -> Program[list[str]]:
    line, problems = setup_line(plan), []
    for device in plan.devices:
        for command in commands.get(device.name, ()):
            if command.safe is None:
                continue
            data = command.data(command.safe)
            reply = yield from retry(line.write(device.servo_id, command.address, data))
            if not reply.answered:
                text = f"did not confirm that {command.item} is {command.safe:g}, its safe value"
                problems.append(f"{plan.label(device)} {text}")
            if reply.outcome is Outcome.TIMEOUT:
                break  # it is not there
    return problems


STAGE = SafeStage(write_safe_values)
