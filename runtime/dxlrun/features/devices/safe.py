"""Safe values of devices: written when a run ends, by the loop or, after it died, by the guardian.

This module needs neither numpy nor the loop, because the guardian uses it after the loop process died.
"""

from __future__ import annotations

from dxlrun.dynamixel.bus_part import SafeStage
from dxlrun.features.devices.plan import DevicesPlan, decode_devices
from dxlwire.bus_plan import BusPlan
from dxlwire.exchange.bus_engine import Lines
from dxlwire.plan.retry import limit_patience, retry, setup_line
from dxlwire.transaction import Program, TransactionOutcome


def write_safe_values(lines: Lines, plan: bytes) -> tuple[str, ...]:
    """Write the safe value of each device command that has one; return a sentence for each failed write.

    Does not raise. Nothing is sent on a line without devices.
    """
    commands = decode_devices(plan)
    if not any(commands.get(device.name) for bus in lines.plans for device in bus.devices):
        return ()
    found = lines.run_programs([limit_patience(_write_safe_values(bus, commands)) for bus in lines.plans])
    return tuple(problem for problems in found for problem in problems or ())


def _write_safe_values(plan: BusPlan, commands: DevicesPlan) -> Program[list[str]]:
    line, problems = setup_line(plan), []
    for device in plan.devices:
        for command in commands.get(device.name, ()):
            if command.safe is None:
                continue
            data = command.data(command.safe)
            reply = yield from retry(line.write_range(device.servo_id, command.address, data))
            if not reply.answered:
                text = f"did not confirm that {command.item} is {command.safe:g}, its safe value"
                problems.append(f"{plan.label(device)} {text}")
            if reply.outcome is TransactionOutcome.TIMEOUT:
                break  # the device does not answer at all
    return problems


STAGE = SafeStage(write_safe_values)
