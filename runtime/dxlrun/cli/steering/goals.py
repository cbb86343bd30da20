"""`dxlrun send` and `cancel`, and functions that wait for the end of goals or cancel them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from msgspec import to_builtins

from dxlrun.cli.inputs import WaitFlag
from dxlrun.cli.steering.steer import ONLY_ONE, RobotChoice, Words, connect_robot, report_done
from dxlrun.errors import DxlrunError, InputError, Refused
from dxlrun.output.terminal import print_error, print_warning, progress_bar, show_json, show_parts

if TYPE_CHECKING:
    from dxlrun.cli.steering.written import WrittenEntry
    from dxlrun.remote.client import Executed, RemoteRobot
    from dxlrun.remote.requests.replies import GoalState

MOST_JOINTS = 3
"""Upper limit of the joints that a result or a list names; more are abbreviated."""
_PROGRESS_S = 0.1
_BEGIN_S = 0.5
"""Time, s, to wait for the number of a goal whose request was interrupted by Ctrl-C."""


def send(
    controller: Annotated[str, Parameter(name="target")],
    kind: Annotated[str, Parameter(name="command")],
    /,
    *words: Words,
    file: Path | None = None,
    in_: Annotated[str | None, Parameter(name="--in", allow_leading_hyphen=True)] = None,
    wait: WaitFlag = False,
    chosen: RobotChoice = ONLY_ONE,
) -> int:
    """Send a command to a controller or a device: `dxlrun send arm position elbow=20deg wrist=0deg`.

    A pose names joints or groups. All other joints keep their goals. Other commands of a controller have
    keys: `dxlrun send base velocity 'linear=0.1 m/s'`. `dxlrun list` shows the commands of each controller.
    A first key that is a name is omitted: `dxlrun send arm pose above`, `dxlrun send player play wave`.
    A device has no command names: `dxlrun send board led=1`.

    Parameters
    ----------
    controller
        Name of the controller or device.
    kind
        Name of the command, or position, velocity, effort or pwm for joints by name. A device has none.
    words
        Keys of the command, or joints, with their values. Values are YAML. Quantities have units.
    file
        YAML file with the keys, in place of words on the command line.
    in_
        Duration of the motion, such as 2s: of joints by name with a controller that takes trajectories, and
        of commands with a key `seconds`.
    wait
        Wait until the goal has ended, with a progress bar, and print the result. Ctrl-C cancels the goal.
        With --no-wait, return as soon as the controller has accepted the command.
    """
    from dxlrun.channels.answers import Code
    from dxlrun.cli.steering.written import WrittenEntry
    from dxlrun.description.source_names import SOURCE_COMMANDS
    from dxlrun.description.units import duration
    from dxlsim.texts.duration import DURATION_NS

    if "=" in controller:
        raise InputError(
            f"{controller} has no controller; write `dxlrun send CONTROLLER position {controller}`"
        )
    for_device = "=" in kind
    if for_device:
        words, kind = (kind, *words), SOURCE_COMMANDS
    # A single word can be the name of a motion or of a pose.
    units = [word for word in words if word in DURATION_NS] if len(words) > 1 else []
    if in_ and in_[-1:].isdigit() and units:
        raise InputError(f"{units[0]!r} is not key=value; write --in {in_}{units[0]} without the space")
    try:
        seconds = None if in_ is None else duration(in_, bare="s") * 1e-9
    except ValueError as error:
        raise InputError(f"--in: {error}") from None
    written = WrittenEntry.from_words(words, file, named=True)  # before a robot is needed
    with connect_robot(chosen.robot, "send") as robot:
        data = _with_key(robot, controller, kind, written) if written.name else written.data
        try:
            with begun_or_cancelled(robot, "send", waited=wait):
                done = robot.send(controller, kind, data, units=True, seconds=seconds, goal=wait)
        except Refused as refused:
            known = refused.fields.get("known")
            mistaken = refused.code == Code.UNKNOWN_COMMAND and refused.fields.get("kind") == kind
            if for_device and mistaken and isinstance(known, list | tuple):
                known = ", ".join(map(str, known))
                what = f"{controller} is a controller: name one of its commands ({known}) before {words[0]!r}"
                raise InputError(what) from None
            raise written.located(refused) from None
        if wait and done.goal is not None:
            return show_goal_progress(robot, chosen, done, [done.goal.number])
        rest = _answer_hint(robot, controller, kind) if done.goal is None else f" as goal {done.goal.number}"
        if wait:
            raise DxlrunError(
                f"{controller} accepted {kind}, but this command has no end to wait for; omit --wait{rest}"
            )
        what = " ".join(words) if for_device else kind
        return report_done(robot, chosen, done, f"{robot.name}: {controller} accepted {what}{rest}")


def _answer_hint(robot: RemoteRobot, controller: str, kind: str) -> str:
    """Return how to see the answer to a command: a topic with its name has it. Empty without this topic."""
    topic = f"/{controller}/{kind}"
    has_answers = any(one.name == topic for one in robot.topics())
    return f"; see the answer by `dxlrun echo {topic} --count 1`" if has_answers else ""


def _with_key(robot: RemoteRobot, controller: str, kind: str, written: WrittenEntry) -> dict[str, object]:
    """Return the keys of a command that begins with a name, which is the value of the first key.

    Raises InputError if that key does not accept a name.
    """
    listed = robot.info().get("controllers")
    takes = [one["takes"] for one in listed if one["name"] == controller] if isinstance(listed, list) else []
    if not takes or kind not in takes[0]:
        return {}  # The robot names the unknown controller or command, or the missing joint
    fields = takes[0][kind].get("properties", {})
    first = next(iter(fields), "")
    field = fields.get(first, {})
    is_name = any(each.get("type") == "string" for each in field.get("anyOf", [field]))
    return written.with_key(first if is_name else "")


def cancel(goal: str = "", /, *, wait: WaitFlag = False, chosen: RobotChoice = ONLY_ONE) -> int:
    """Cancel goals of a running robot.

    Their controllers bring the joints to rest. A motion with an exit plays it; a second cancel stops it.

    Parameters
    ----------
    goal
        Number of a goal, or name of a controller. Default: all active goals.
    wait
        Wait until the joints are at rest, also through exits. With --no-wait, return as soon as the loop has
        accepted the request.
    """
    from dxlrun.channels.answers import Code

    with connect_robot(chosen.robot, "cancel") as robot:
        states = robot.goals()
        if not goal:
            wanted = [state.number for state in states if state.status == "running"]
        elif goal.isdecimal():
            wanted = [int(goal)]
        else:
            wanted = [one.number for one in states if (one.controller, one.status) == (goal, "running")]
        if goal and not wanted:
            # The robot refuses this with the reason.
            robot.cancel(goal)
        cancelled = []
        for number in wanted:
            try:
                robot.cancel(number)
            except Refused as refused:
                if goal or refused.code not in (Code.GOAL_ENDED, Code.CANCELLED_ALREADY):
                    raise
                # Without a name, a goal that has ended in the meantime needs no cancel.
                continue
            cancelled.append(number)
        if wait:
            for number in cancelled:
                robot.wait(number)
        if chosen.as_json:
            show_json({"robot": robot.name, "goals": cancelled})
        elif not cancelled:
            show_parts(f"{robot.name}: no goal runs")
        else:
            shown = ", ".join(map(str, cancelled))
            show_parts(f"{robot.name}: goal{'s' if len(cancelled) > 1 else ''} {shown} cancelled")
    return 0


@contextmanager
def begun_or_cancelled(robot: RemoteRobot, verb: str, *, waited: bool) -> Iterator[None]:
    """Within the block that sends a goal, cancel that goal on Ctrl-C, even before its number is known.

    Only if the command was to wait for the goal (`waited`); `verb` is the command, by which the goal is
    found.
    """
    last = max((state.number for state in robot.goals()), default=0) if waited else 0
    try:
        yield
    except KeyboardInterrupt:
        if waited:
            until = time.monotonic() + _BEGIN_S
            own: list[int] = []
            while not own and time.monotonic() < until:
                time.sleep(_PROGRESS_S)
                own = [
                    state.number
                    for state in robot.goals()
                    if state.number > last and state.origin.startswith(f"dxlrun {verb}")
                ]
            for state in cancel_goals(robot, own):
                print_warning(f"dxlrun: {state.describe_outcome()}")
        raise


def show_goal_progress(
    robot: RemoteRobot, chosen: RobotChoice, done: Executed, numbers: Sequence[int], motion: str = ""
) -> int:
    """Show the progress of goals until all have ended, print their results, and return the exit code.

    `motion` is the played motion. Ctrl-C cancels the goals, waits until their joints are at rest, and is
    raised again.
    """
    try:
        if not chosen.as_json and robot.info()["paused"]:
            print_warning(f"dxlrun: {robot.name} is paused; its goals wait until `dxlrun resume`")
        states = _ended(robot, numbers, motion, hidden=chosen.as_json)
    except KeyboardInterrupt:
        states = cancel_goals(robot, numbers)
        if not chosen.as_json:
            for state in states:
                print_warning(f"dxlrun: {state.describe_outcome()}")
        raise
    reached = all(state.reached for state in states)
    if chosen.as_json:
        goals = [_shown(state) for state in states]
        result: dict[str, object] = {"robot": robot.name, "cycle": done.cycle}
        result |= {"motion": motion} if motion else {}
        result |= goals[0] if len(goals) == 1 else {"goals": goals}
        missed = [state.describe_outcome() for state in states if not state.reached]
        show_json(result, code=0 if reached else 1, errors=missed)
        return 0 if reached else 1
    joints = _joints(robot) if motion else {}
    for state in states:
        moved = joints.get(state.controller, ())
        played = f"{motion} ({', '.join(moved[:MOST_JOINTS])}{' ...' * (len(moved) > MOST_JOINTS)}): "
        text = f"{played if motion else ''}{state.describe_outcome()}"
        if state.reached:
            show_parts(f"{robot.name}: {text}")
        else:
            print_error(f"dxlrun: {text}")
    return 0 if reached else 1


def _joints(robot: RemoteRobot) -> dict[str, Sequence[str]]:
    """Return the joints of each controller of the robot by the controller's name."""
    listed = robot.info().get("controllers")
    return {one["name"]: one["joints"] for one in (listed if isinstance(listed, list) else [])}


def _ended(robot: RemoteRobot, numbers: Sequence[int], motion: str, *, hidden: bool) -> list[GoalState]:
    """Wait until all goals have ended, with a progress bar on a terminal, and return their final states."""
    states = {number: robot.goal_state(number) for number in numbers}
    with progress_bar(hidden=hidden) as draw:
        while running := [state for state in states.values() if state.status == "running"]:
            slowest = min(running, key=lambda state: state.progress)
            draw(f"{motion or slowest.kind}: {slowest.controller}", slowest.progress)
            states[slowest.number] = robot.goal_state(slowest.number, _PROGRESS_S)
            for state in running:
                if state is not slowest:
                    states[state.number] = robot.goal_state(state.number)
    return list(states.values())


def cancel_goals(robot: RemoteRobot, numbers: Sequence[int]) -> list[GoalState]:
    """Cancel goals, wait until their joints are at rest, and return their final states.

    Ctrl-C during the wait cancels them again, which stops motions that are playing their exits, and does not
    wait for others. Errors are printed; a goal without a result is not returned.
    """
    try:
        return _cancel_once(robot, numbers)
    except KeyboardInterrupt:
        return _cancel_once(robot, numbers, again=True)


def _cancel_once(robot: RemoteRobot, numbers: Sequence[int], *, again: bool = False) -> list[GoalState]:
    from dxlrun.channels.answers import Code

    states, ending = [], []
    for number in numbers:
        try:
            robot.cancel(number)
        # The goal has ended in the meantime, or is already being cancelled.
        except Refused as refused:
            if again and refused.code == Code.CANCELLED_ALREADY:
                print_warning(f"dxlrun: {refused}")
                continue
        except DxlrunError as error:
            print_error(f"dxlrun: {error}")
            return []
        ending.append(number)
    for number in ending:
        try:
            states.append(robot.wait(number))
        except DxlrunError as error:
            print_error(f"dxlrun: {error}")
    return states


def _shown(state: GoalState) -> dict[str, object]:
    fields: dict[str, object] = to_builtins(state)
    return {name: fields[name] for name in fields if name not in {"accepted", "ended"}} | {
        "seconds": state.seconds
    }
