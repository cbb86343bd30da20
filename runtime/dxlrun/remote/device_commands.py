"""Commands of devices by name: given to the controller that commands them now."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import msgspec

from dxlrun.channels.answers import Code, Field
from dxlrun.errors import suggestion
from dxlrun.plan.loop_plan import ControllerPlan, SourcePlan
from dxlrun.remote.preparation import invalid, refused

DEVICE_COMMANDS = "device_commands"
"""The command of controllers that take values for devices: `{"values": {"board/led": 1}}`."""


def device_command(
    device: SourcePlan,
    body: bytes,
    controllers: Sequence[ControllerPlan],
    active: Callable[[ControllerPlan], bool],
    takes: Callable[[ControllerPlan], Mapping[str, object]],
) -> tuple[str, bytes]:
    """Return the controller that is given values for a device, and its command as JSON.

    `body` is JSON with a value for each command, `{"led": 1}`, SI units. Raises RefusedRequest.
    """
    try:
        given = msgspec.json.decode(body, type=dict[str, object])
    except (msgspec.MsgspecError, RecursionError) as error:
        raise invalid(f"{error}; write for example led=1") from error
    ranges = dict(zip(device.commands, device.ranges, strict=True))
    if not ranges:
        raise invalid(f"{device.label} has no commands; name items under its `commands` in the robot file")
    if not given:
        raise invalid(f"{device.label}: no command is named; it has {', '.join(ranges)}")
    for name, value in given.items():
        if name not in ranges:
            fields: dict[str, Field] = {
                "controller": device.name,
                "kind": name[:80],
                "known": device.commands,
            }
            raise refused(Code.UNKNOWN_COMMAND, fields | {"hint": suggestion(name[:80], device.commands)})
        lowest, highest = ranges[name]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise invalid(f"{device.name}/{name} = {str(value)[:40]} is no number")
        if not lowest <= value <= highest:
            problem = f"{value:g} lies outside {lowest:g} to {highest:g}"
            raise refused(Code.BEYOND_LIMITS, {"controller": device.name, "kind": name, "problem": problem})
    values = {f"{device.name}/{name}": value for name, value in given.items()}
    chosen = {_commander(name, controllers, active, takes) for name in values}
    if len(chosen) > 1:
        raise invalid(f"{', '.join(values)} are commanded by {', '.join(sorted(chosen))}: send one at a time")
    return chosen.pop(), msgspec.json.encode({"values": values})


def _commander(
    name: str,
    controllers: Sequence[ControllerPlan],
    active: Callable[[ControllerPlan], bool],
    takes: Callable[[ControllerPlan], Mapping[str, object]],
) -> str:
    """Return the active controller that takes values for a command of a device; raises RefusedRequest."""
    claiming = [plan for plan in controllers if name in plan.device_commands]
    now = [plan for plan in claiming if active(plan)]
    if now and DEVICE_COMMANDS in takes(now[0]):
        return now[0].name
    able = [plan.name for plan in claiming if DEVICE_COMMANDS in takes(plan)]
    if able:
        hint = f"`dxlrun switch --activate {able[0]}"
        hint += f" --deactivate {now[0].name}`" if now else "`"
    else:
        hint = "write into the robot file, under controllers, "
        hint += f"NAME: {{type: device_command_controller, commands: [{name}]}}"
    by = f"commanded by {now[0].name}, which takes no values for it" if now else "commanded by no controller"
    raise invalid(f"{name} is {by}; {hint}")
