"""Device checks: at start-up each device on a bus must answer, be of its model, and return its states."""

from __future__ import annotations

from msgspec.structs import replace

from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.remedies import choose_remedy
from dxlrun.features.devices import texts
from dxlwire.bus_plan import BusPlan, DevicePlan
from dxlwire.control_table import models_by_number
from dxlwire.control_table.device_models import devices_by_number
from dxlwire.plan.line import Line
from dxlwire.plan.retry import retry, setup_line
from dxlwire.transaction import Program, TransactionOutcome

_MODEL_NUMBER = (0, 2)
"""Address and size of the item Model Number (0), in both protocols (e-Manual AX-12A, XM430-W350)."""


_SILENCE_NS = 60_000_000
"""Time without traffic, ns, before a silent device is pinged again: a board that waits for a status of an
earlier chain gives up after 50 ms (protocol.md)."""


def survey_devices(plan: BusPlan, found: Findings) -> Program[None]:
    """Check all devices of a bus by reading only; add problems and the devices found to `found`."""
    line = setup_line(plan)
    for device in plan.devices:
        ping = line.ping(device.servo_id)
        if (yield ping).outcome is TransactionOutcome.TIMEOUT:
            yield replace(ping, timeout_ns=_SILENCE_NS)  # another program may have left it waiting
        problem = yield from inspect_device(plan, device, line)
        if problem:
            found.problems.append(f"{plan.label(device)} {problem}")
        else:
            found.add_event(device.name, texts.device_found(device.model, device.servo_id, plan.name))


def inspect_device(plan: BusPlan, device: DevicePlan, line: Line) -> Program[str]:
    """Ping a device, read its model number and states; return the problem, empty if there is none."""
    reply = yield from retry(line.ping(device.servo_id))
    if reply.outcome is TransactionOutcome.TIMEOUT:
        rate = f"baud rate ({plan.baud_rate} bit/s)"
        remedy = choose_remedy(
            plan.port, f"check power, cable, ID and {rate}", simulated=f"check its ID and {rate}"
        )
        return f"does not answer: {remedy}"
    if reply.outcome is TransactionOutcome.GARBLED:
        remedy = choose_remedy(plan.port, " If not, check its cable", simulated="")
        return f"sends garbled or double replies: does something else have its ID?{remedy}"
    if device.model_number is not None:
        reply = yield from retry(line.read_range(device.servo_id, *_MODEL_NUMBER))
        if not reply.answered:
            remedy = choose_remedy(plan.port, "check its cable and its firmware")
            return f"answers pings, but its model number cannot be read: {remedy}"
        if (number := reply.word()) != device.model_number:
            return (
                f"has model number {number}{_known(number, plan.protocol)}, not {device.model_number} "
                f"({device.model}): correct `model` or the ID"
            )
    for block in device.blocks:
        reply = yield from retry(line.read_range(device.servo_id, block.address, block.length, block.spare))
        if not reply.answered:
            end = block.address + block.length - 1
            why = "rejects reads" if reply.outcome is TransactionOutcome.REFUSED else "cannot be read"
            return f"{why} at addresses {block.address} to {end}: is it a {device.model}?"
    return ""


def _known(number: int, protocol: float) -> str:
    models = [table.model for table in models_by_number(number, protocol)]
    models += [table.model for table in devices_by_number(number, protocol)]
    return f" ({models[0]})" if models else ""
