"""`dxlrun echo`: print the messages of a running robot's topic as they arrive."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from dxlrun.cli.inputs import Hertz
from dxlrun.cli.steering.steer import ONLY_ONE, RobotChoice, connect_robot
from dxlrun.errors import InputError
from dxlrun.output.terminal import show_json, show_parts
from dxlrun.output.text_table import Column, Columns, Table

if TYPE_CHECKING:
    from dxlrun.remote.live.listening import TopicMessage
    from dxlrun.remote.requests.replies import TopicState

_NAMES = ("name", "joint_names")
"""Fields of ROS 2 messages that have the names of joints, for the rows of the other fields."""


def echo(
    topic: str | None = None,
    /,
    *,
    count: int | None = None,
    rate: Hertz | None = None,
    chosen: RobotChoice = ONLY_ONE,
) -> int:
    """Print the messages of a topic as they arrive: `dxlrun echo /arm/state`.

    Without a topic, all topics are listed. The command ends with the run, or on Ctrl-C.

    Parameters
    ----------
    topic
        Name of the topic. The leading / is optional.
    count
        Number of messages to print. Default: all until the end of the run.
    rate
        Largest number of messages per second, Hz. Older messages are skipped. Default: no limit.
    """
    if count is not None and count < 1:
        raise InputError(f"--count {count} is not a number of messages; give 1 or more")
    # Also refuses NaN.
    if rate is not None and not 0 < rate < math.inf:
        raise InputError(f"--rate {rate:g} is not a rate; give a number of Hz above 0")
    with connect_robot(chosen.robot, "echo") as robot:
        if topic is None:
            states = robot.topics()
            if chosen.as_json:
                show_json(states)
            else:
                show_parts(topics(states))
            return 0
        try:
            for number, message in enumerate(robot.listen(topic, rate=rate), 1):
                print_message(message, as_json=chosen.as_json)
                if number == count:
                    break
        except KeyboardInterrupt:
            # Ctrl-C is the normal end.
            return 0
    return 0


def topics(states: Sequence[TopicState]) -> Table:
    """Return a table of topics: name, type, number of messages and rate."""
    columns: Columns[TopicState] = [
        (Column("topic", "name"), "name"),
        (Column("type", "text"), "type"),
        (Column("messages"), "count"),
        (Column("rate", form="{:.4g} Hz"), "rate"),
    ]
    return Table.listing("", columns, states)


def print_message(message: TopicMessage, *, as_json: bool) -> None:
    """Print a message: JSON in one line, or one line per field after a line with `---`."""
    import msgspec

    time = message.time_ns * 1e-9
    plain = msgspec.json.decode(msgspec.json.encode(message.message, enc_hook=lambda array: array.tolist()))
    if as_json:
        show_json(
            {
                "topic": message.topic,
                "number": message.number,
                "time": time,
                "lost": message.lost,
                "message": plain,
            }
        )
        return
    lost = f", {message.lost} missed before it" if message.lost else ""
    head = f"--- {message.topic} {message.number}, {time:.3f} s{lost}"
    show_parts("\n".join([head, *fields(plain, message.joints)]))


def fields(message: Mapping[str, object], joints: Sequence[str]) -> list[str]:
    """Return the lines of a decoded message; `joints` name the rows of arrays, unless the message names
    them.
    """
    for name in _NAMES:
        named = message.get(name)
        if isinstance(named, list) and named and all(isinstance(one, str) for one in named):
            joints = named
    return list(_lines(message, joints, ""))


def _lines(message: Mapping[str, object], joints: Sequence[str], indent: str) -> Iterator[str]:
    for name, value in message.items():
        if isinstance(value, Mapping):
            yield f"{indent}{name}:"
            yield from _lines(value, joints, f"{indent}  ")
        elif not isinstance(value, list):
            yield f"{indent}{name}: {_scalar(value)}"
        elif any(isinstance(one, Mapping) for one in value):
            yield f"{indent}{name}:"
            for one in value:
                first, *rest = _lines(one, joints, "") if isinstance(one, Mapping) else [_scalar(one)]
                yield f"{indent}- {first}"
                yield from (f"{indent}  {line}" for line in rest)
        elif joints and len(value) == len(joints) and not any(isinstance(one, str) for one in value):
            yield f"{indent}{name}:"
            yield from (
                f"{indent}  {joint}: {_scalar(one)}" for joint, one in zip(joints, value, strict=True)
            )
        else:
            yield f"{indent}{name}: [{', '.join(map(_scalar, value))}]"


def _scalar(value: object) -> str:
    if value is None:
        return "nan"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value) if isinstance(value, int) else f'"{value}"' if value == "" else str(value)
