"""Texts of the gateway: problems and hints of its refusals. Their codes are in `channels/answers.py`."""

from __future__ import annotations

from collections.abc import Collection, Sequence

# Numbers and bodies


def not_a_number(name: str, value: object) -> str:
    return f"{name}={str(value)[:40]} is not a number"


def not_a_goal_number(text: str) -> str:
    return f"{text[:40]!r} is not the number of a goal; write a whole number, such as 3"


def wait_out_of_range(wait_s: float, longest_s: float) -> str:
    return f"wait={wait_s:g} is out of range; write 0 to {longest_s:g} s"


def lease_out_of_range(lease_s: float, shortest_s: float, longest_s: float) -> str:
    return f"a lease of {lease_s:g} s is out of range; write {shortest_s:g} to {longest_s:g} s"


def speed_out_of_range(speed: float, lowest: float, highest: float) -> str:
    return f"a speed of {speed:g} is out of range; write a factor from {lowest:g} to {highest:g}"


def duration_out_of_range(seconds: float, longest_s: float) -> str:
    return f"a duration of {seconds:g} s is out of range; write a time above 0 s, at most {longest_s:g} s"


def no_body(error: object, example: str) -> str:
    return f"{error}; write for example {example}"


def not_json(what: str, error: object) -> str:
    return f"{what} is not JSON: {error}"


BODY_TOO_DEEP = "the body is nested too deeply; use fewer levels"
NO_TOPIC = "name a topic, and a rate above 0 Hz; write for example /stream?topic=/joint_states"
SEND_AS_COMMAND = "send the values as a command"


def not_sendable(error: object) -> str:
    return f"the request cannot be sent: {error}; use numbers, texts, lists and mappings"


def not_finite(place: str, value: object) -> str:
    return f"{place} is {value}, but must be a finite number; correct it"


# Joints and registers

NAME_JOINTS = "name joints, groups, controllers, or all"


def no_reboot(servos: Sequence[str]) -> str:
    verb = "has" if len(servos) == 1 else "have"
    return f"{', '.join(servos)} {verb} no reboot instruction; switch the torque or the power off and on"


def no_register(model: str, item: str) -> str:
    return f"an {model} has no register {item}"


def register_list(model: str) -> str:
    return f"list the registers by `dxlrun models {model}`"


def wrong_value(joint: str, item: str, error: object) -> str:
    return f"{item} of {joint}: {error}"


def not_a_servo(name: str) -> str:
    return f"{name} is not a servo; print its states by `dxlrun get {name}`"


def several_models(joint: str, models: Collection[str], servos: Collection[str]) -> str:
    names = ", ".join(servos)
    return f"{joint} has servos of several models ({', '.join(models)}); name one of them: {names}"


def joint_cannot_move(immovable: str) -> str:
    return f"{immovable}; set the register above 0"


# Commands by the names of joints


def no_joint_named(controller: str, kind: str, joint: str) -> str:
    return f"{kind} of {controller} names no joint; write for example {joint}=20deg"


def not_moved(controller: str, joint: str, joints: Collection[str]) -> str:
    return f"{controller} does not move {joint}; it moves {', '.join(joints)}"


def moved_by(controllers: Collection[str]) -> str:
    return f"this is a joint; name a controller that moves it: {', '.join(controllers)}"


def wrong_order(controller: str, kind: str) -> str:
    return f"write the controller first: {controller} {kind}"


def takes_no_time(controller: str) -> str:
    return f"{controller} moves its joints immediately; omit the time"


def has_own_times(controller: str, kind: str) -> str:
    return f"{kind} of {controller} contains its own times; omit the duration"


def value_not_finite(controller: str, kind: str, joint: str, value: object) -> str:
    fix = "give it in SI units, or `units=True` for texts with units"
    return f"{kind} of {controller}: {joint} is {str(value)[:40]!r}, but must be a finite number; {fix}"


def quantities_of_joints(controller: str, quantities: Sequence[str]) -> str:
    return f"{controller} accepts {', '.join(quantities)} for each joint"


def value_not_known(joint: str, quantity: str) -> str:
    return f"the {quantity} of {joint} are not known yet; add {joint} to the command"


# Commands of devices


def source_without_commands(source: str) -> str:
    return f"{source} has no commands; name items under its `commands` in the robot file"


def no_command_named(source: str, commands: Collection[str]) -> str:
    return f"the request names no command of {source}; name one of {', '.join(commands)}"


def source_value_not_a_number(source: str, command: str, value: object) -> str:
    return f"{source}/{command} = {str(value)[:40]} is not a number"


def outside(value: float, lowest: float, highest: float) -> str:
    return f"{value:g} is outside {lowest:g} to {highest:g}"


def several_commanders(commands: Collection[str], controllers: Collection[str]) -> str:
    by = ", ".join(sorted(controllers))
    return f"{', '.join(commands)} are commanded by {by}; send one command at a time"


def not_commandable(command: str, commander: str, able: str) -> str:
    """Return the refusal of a value for a command of a device.

    Args:
        command: The command, `light/led`.
        commander: Active controller that claims it without taking values; empty: none.
        able: Controller that would take values; empty: none.
    """
    by = (
        f"commanded by {commander}, and clients cannot send values for it"
        if commander
        else "commanded by no controller"
    )
    if able:
        fix = f"`dxlrun switch --activate {able}{f' --deactivate {commander}' if commander else ''}`"
    else:
        entry = f"NAME: {{type: device_command_controller, commands: [{command}]}}"
        fix = f"add to `controllers` in the robot file: {entry}"
    return f"{command} is {by}; {fix}"


# Controllers and parameters

NO_PARAMETER = 'nothing to change; write for example {"values": {"speed": "20 deg/s"}}'
OTHER_NAME = "choose another name, or unload that controller"


def type_missing(controller: str, kind: str) -> str:
    return f"the plug-in with the type {kind} of {controller} is missing; install it again"


def name_too_long(longest: int) -> str:
    return f"a name has at most {longest} characters; choose a shorter one"


def active_at_once(controller: str) -> str:
    return f"controllers are loaded inactive; load {controller} first, then switch to it"


def registers_loaded(controller: str) -> str:
    return f"{controller} changes registers, so it cannot be loaded; write it into the robot file"


def parameter_parts(parts: Sequence[str]) -> str:
    return f"name one of its values: {', '.join(parts)}"


def live_parameters(names: Sequence[str]) -> str:
    return f"live are {', '.join(names)}" if names else "it has no live parameters"


def parameter_not_a_number(name: str, value: object) -> str:
    return f"{name} = {value!r} cannot change in a run; only numbers and bools can"
