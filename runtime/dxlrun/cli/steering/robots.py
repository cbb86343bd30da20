"""`dxlrun list`: the robots that run, their controllers, and what these take."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator, Mapping

from dxlrun.cli.output.flags import Flag, JsonFlag
from dxlrun.cli.output.terminal import out, say_error
from dxlrun.errors import DxlrunError, InputError, suggestion


def list_robots(*, robot: str | None = None, as_json: JsonFlag = False, debug: Flag = False) -> int:
    """List the robots that run and can be steered, with their controllers and the commands these take.

    Parameters
    ----------
    robot
        Only the robot of this name.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    from dxlrun.remote.client import connect, running

    names = running()
    if robot is not None and robot not in names:
        raise InputError(f"no robot {robot} runs; {suggestion(robot, names)}")
    told, code = [], 0
    for name in names if robot is None else (robot,):
        try:
            with connect(name, "dxlrun list") as one:
                told.append({**one.info(), "name": name})
        except DxlrunError as error:  # it may have ended meanwhile; the others are told
            say_error(f"dxlrun: {error}")
            code = 1
    console = out()
    if as_json:
        console.file.write(json.dumps(told, indent=2, ensure_ascii=False) + "\n")
        return code
    for info in told:
        console.print(headline(info), markup=False, soft_wrap=True)
        for line in controllers(info, console.width):
            console.print(line, markup=False, soft_wrap=True)
    if not names:
        console.print("no robot runs that could be steered; `dxlrun ROBOT.yaml` starts one", soft_wrap=True)
    return code


def headline(info: Mapping[str, object]) -> str:
    """Say how a robot is."""
    paused = ", paused" if info["paused"] else ""
    periods = f"{info['skipped']} {'period' if info['skipped'] == 1 else 'periods'} skipped"
    log = f"log {info['log']}" if info["log"] else "no log"
    return f"{info['name']}: {info['rate']:g} Hz{paused}, {info['cycles']} cycles, {periods}, {log}"


def controllers(info: Mapping[str, object], width: int) -> Iterator[str]:
    """Yield a line for each controller, and below it its joints in their order, wrapped to the terminal."""
    rows = info["controllers"]
    told = rows if isinstance(rows, list) else []
    longest = max((len(one["name"]) for one in told), default=0)
    for one in told:
        takes = "; ".join(command(kind, schema) for kind, schema in one["takes"].items())
        line = f"  {one['name']:{longest}}  {state(one):8}  {one['rate']:6g} Hz  {takes}"
        yield line.rstrip()
        if one["command"]:  # who only looks has no joints of its own
            yield textwrap.fill(
                "moves " + ", ".join(one["joints"]),
                max(width - 1, 20),
                initial_indent="      ",
                subsequent_indent="      ",
                break_long_words=False,
                break_on_hyphens=False,
            )


def state(controller: Mapping[str, object]) -> str:
    """Say what a controller does."""
    if not controller["active"]:
        return "inactive"
    return "held" if controller["held"] else "active"


def command(kind: str, schema: Mapping[str, object]) -> str:
    """Say what is in a command, from its JSON Schema; what may be left out stands in brackets."""
    properties, required = schema.get("properties"), schema.get("required")
    needed = required if isinstance(required, list) else []
    names = properties if isinstance(properties, dict) else {}
    keys = (name if name in needed else f"[{name}]" for name in names)
    return f"{kind}: {', '.join(keys)}" if names else kind
