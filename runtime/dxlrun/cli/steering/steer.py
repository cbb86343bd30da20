"""The verbs that steer a robot while it runs.

Each is one request to the gateway of the run: obeyed at the start of a cycle, or refused with the reason.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.output.flags import Flag, JsonFlag
from dxlrun.cli.output.terminal import out
from dxlrun.errors import DxlrunError, InputError, suggestion

if TYPE_CHECKING:
    from dxlrun.remote.client import RemoteRobot

Names = Annotated[tuple[str, ...], Parameter(negative=(), show_default=False, consume_multiple=True)]
"""Names of controllers, one or several behind the option."""
Words = Annotated[str, Parameter(name="key=value")]


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Whom:
    """The robot that is meant, and how it is told.

    Parameters
    ----------
    robot
        Name of the robot, where several run.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """

    robot: str | None = None
    as_json: JsonFlag = False
    debug: Flag = False


ONLY_ONE = Whom()
"""The one robot that runs."""


def switch(*, activate: Names = (), deactivate: Names = (), whom: Whom = ONLY_ONE) -> int:
    """Activate and deactivate controllers of a running robot in one cycle, or not at all.

    Parameters
    ----------
    activate
        These controllers get their joints.
    deactivate
        These let go of theirs.
    """
    if not activate and not deactivate:
        raise InputError("nothing to switch; write --activate NAME, --deactivate NAME, or both")
    with _robot(whom, "switch") as robot:
        _known(robot, *activate, *deactivate)
        robot.switch(activate, deactivate)
        groups = {
            "active": [name for name in activate if name not in deactivate],
            "not active any more": [name for name in deactivate if name not in activate],
            "begun anew": [name for name in activate if name in deactivate],
        }
        parts = [f"{', '.join(names)} {state}" for state, names in groups.items() if names]
        return _done(robot, whom, f"{robot.name}: {'; '.join(parts)}")


def send(
    controller: str, kind: str, /, *words: Words, file: Path | None = None, whom: Whom = ONLY_ONE
) -> int:
    """Give a controller of a running robot a command: `dxlrun send neck positions 'positions=[30 deg]'`.

    `dxlrun list` shows which commands a controller takes, and what is in them.

    Parameters
    ----------
    controller
        Name of the controller.
    kind
        The command.
    words
        What is in it; values are YAML, quantities have their units.
    file
        A YAML file with what is in it, instead of the words.
    """
    from dxlrun.cli.steering.written import Written, is_played

    written = Written.read(words, file)
    with _robot(whom, "send") as robot:
        takes = _known(robot, controller)[controller]
        if kind not in takes:
            raise InputError(f"{controller} takes no command {kind}; {suggestion(kind, tuple(takes))}")
        command = written.in_si() if is_played(kind, takes[kind]) else written.data
        robot.send(controller, kind, command)
        return _done(robot, whom, f"{robot.name}: {controller} has taken {kind}")


def set_register(joint: str, item: str, value: str, /, *, whom: Whom = ONLY_ONE) -> int:
    """Change a register of a servo while the robot runs: `dxlrun set elbow_joint position_p_gain 900`.

    Items of the RAM that no controller commands; returns when the servo has it. `dxlrun models` lists them.

    Parameters
    ----------
    joint
        Name of the joint.
    item
        Item of its servo's control table.
    value
        Whole number as in the e-Manual, or a quantity with its unit, such as '10 rad/s^2'.
    """
    from dxlrun.description.source.scalars import plain_value

    number = plain_value(value)
    wanted = number if isinstance(number, int) and not isinstance(number, bool) else value
    with _robot(whom, "set") as robot:
        robot.set_register(joint, item, wanted)
        return _done(robot, whom, f"{robot.name}: {item} of {joint} is {wanted}")


def rate(hz: float, /, *, whom: Whom = ONLY_ONE) -> int:
    """Let the loop of a running robot run at another rate.

    Parameters
    ----------
    hz
        Cycles per second, Hz.
    """
    if not 0 < hz < float("inf"):  # false for nan too
        raise InputError(f"{hz:g} is no rate; give a number of Hz above 0")
    with _robot(whom, "rate") as robot:
        robot.rate(hz)
        return _done(robot, whom, f"{robot.name} runs at {hz:g} Hz")


def pause(*, whom: Whom = ONLY_ONE) -> int:
    """Pause a running robot: its joints are held, its controllers' time stands still."""
    with _robot(whom, "pause") as robot:
        robot.pause()
        return _done(robot, whom, f"{robot.name} is paused, its joints are held; `dxlrun resume` goes on")


def resume(*, whom: Whom = ONLY_ONE) -> int:
    """Let the controllers of a paused robot go on where they were."""
    with _robot(whom, "resume") as robot:
        robot.resume()
        return _done(robot, whom, f"{robot.name} goes on")


def load(name: str, /, *words: Words, file: Path | None = None, whom: Whom = ONLY_ONE) -> int:
    """Load another controller into a paused robot; it is not active until it is switched on.

    Parameters
    ----------
    name
        Name of the new controller.
    words
        Its keys as in the robot file, such as type=joint_group_position_controller 'joints=[head_yaw_joint]'.
    file
        A YAML file with its keys, instead of the words.
    """
    from dxlrun.cli.steering.written import Written

    entry = Written.read(words, file).data
    if "type" not in entry:
        raise InputError(f"{name} has no type; give it one, such as type=joint_group_position_controller")
    with _robot(whom, "load") as robot:
        robot.load(name, entry)
        return _done(
            robot, whom, f"{robot.name}: {name} is loaded; `dxlrun switch --activate {name}` starts it"
        )


def unload(name: str, /, *, whom: Whom = ONLY_ONE) -> int:
    """Take a controller that is not active out of a paused robot.

    Parameters
    ----------
    name
        Name of the controller.
    """
    with _robot(whom, "unload") as robot:
        _known(robot, name)
        robot.unload(name)
        return _done(robot, whom, f"{robot.name}: {name} is unloaded")


def stop(*, no_wait: Flag = False, whom: Whom = ONLY_ONE) -> int:
    """End a running robot in order, as its policy on_exit says.

    Parameters
    ----------
    no_wait
        Return as soon as the loop has taken it.
    """
    with _robot(whom, "stop") as robot:
        robot.stop(wait=not no_wait)
        return _done(robot, whom, f"{robot.name} {'is ending' if no_wait else 'has ended'}")


def _robot(whom: Whom, verb: str) -> RemoteRobot:
    """Return the robot that is meant; raises InputError when it is not clear, DxlrunError when none runs."""
    from dxlrun.remote.client import connect, running

    names = running()
    if not names:
        raise DxlrunError("no robot runs that could be steered; `dxlrun ROBOT.yaml` starts one")
    if whom.robot is None and len(names) > 1:
        raise InputError(f"several robots run; choose one: --robot {', --robot '.join(names)}")
    if whom.robot is not None and whom.robot not in names:
        raise InputError(f"no robot {whom.robot} runs; {suggestion(whom.robot, names)}")
    return connect(whom.robot or names[0], f"dxlrun {verb}")


def _known(robot: RemoteRobot, *names: str) -> dict[str, Mapping[str, Mapping[str, object]]]:
    """Return which commands each controller takes, by name; raises InputError when one of `names` is none."""
    told = robot.info()["controllers"]
    takes = {one["name"]: one["takes"] for one in told} if isinstance(told, list) else {}
    wrong = [
        f"{robot.name} has no controller {name}; {suggestion(name, tuple(takes))}"
        for name in names
        if name not in takes
    ]
    if wrong:
        raise InputError("\n".join(wrong))
    return takes


def _done(robot: RemoteRobot, whom: Whom, sentence: str) -> int:
    console = out()
    if whom.as_json:
        console.file.write(json.dumps({"robot": robot.name, "done": True}) + "\n")
    else:
        console.print(sentence, markup=False, soft_wrap=True)
    return 0
