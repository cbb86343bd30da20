"""`dxlrun watch`: a live view of a running robot in the terminal, or one snapshot in a pipe."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

from dxlrun.channels.commands import OWN_ORIGIN
from dxlrun.cli.inputs import Flag
from dxlrun.cli.steering.steer import ONLY_ONE, RobotChoice, Row, connect_robot, state
from dxlrun.errors import DxlrunError, Refused
from dxlrun.output.escaping import escaped
from dxlrun.output.live_view import compact, keys_pressed
from dxlrun.output.quantity import quantity_text
from dxlrun.output.terminal import STYLES, out, show_json, show_parts
from dxlrun.output.text_table import Cell, Column, Columns, Sentence, Table, Tone
from dxlwire.joint_unit import JointUnit

if TYPE_CHECKING:
    from rich.console import Group, RenderableType
    from rich.text import Text

    from dxlrun.remote.client import RemoteRobot
    from dxlrun.remote.live.states import RobotStates

REFRESH_S = 0.2
_RATE_S = 1.0
"""Time over which the loop's rate is measured, s."""
_LONGEST_EVENTS = 200
_TONES: Mapping[str, Tone] = {"on": "good", "doubt": "warning", "lost": "error", "limp": "warning"}


@dataclass(slots=True)
class WatchedRobot:
    """Newest states, controllers and events of a running robot, as requested by `poll_robot`."""

    robot: RemoteRobot
    states: RobotStates = field(init=False)
    info: Row = field(default_factory=dict)
    events: list[Row] = field(default_factory=list)
    rate: float | None = None
    """Rate of the loop measured from its cycles, Hz; None before the first measurement."""
    latest: float = 0.0
    """Largest delay of the loop's wake-up among the cycles that were requested, s."""
    _last: int = 0
    _cycle: tuple[int, float] = (0, 0.0)

    def poll_robot(self) -> None:
        """Request states, controllers and new events from the robot; raises DxlrunError when it is gone."""
        self.info = cast("Row", self.robot.info())
        self.states = self.robot.states()
        found = cast("Row", self.robot.events(self._last))
        self._last = found["last"]
        self.events += found["events"]
        # Events of the guardian arrive later.
        self.events.sort(key=lambda event: event["time"])
        del self.events[:-_LONGEST_EVENTS]
        cycle, now = self.states.cycle, self.states.time_ns * 1e-9
        self.latest = max(self.latest, self.states.late_ns * 1e-9)
        if not self._cycle[1]:
            self._cycle = cycle, now
        elif now - self._cycle[1] >= _RATE_S:
            self.rate = (cycle - self._cycle[0]) / (now - self._cycle[1])
            self._cycle = cycle, now

    def json(self) -> Row:
        """Return states, controllers and the events since the last call, for one line of JSON."""
        from dxlrun.remote.live.states import encoded

        kept = ("name", "active", "held", "rate", "joints")
        rows = self.info["controllers"]
        controllers = [{key: row[key] for key in kept if key in row} for row in rows]
        events, self.events = self.events, []
        known = {key: self.info[key] for key in ("rate", "paused", "cycles", "skipped")}
        return {
            "robot": self.robot.name,
            **known,
            "measured_rate": self.rate,
            **json.loads(encoded(self.states)),
            "controllers": controllers,
            "events": events,
        }


def watch_robot(*, once: Flag = False, chosen: RobotChoice = ONLY_ONE) -> int:
    """Watch a running robot live: joints, controllers, rate and events.

    q or Ctrl-C ends the command. In a pipe, one snapshot is printed as tables. With --json, objects are
    printed until the run ends, one per line.

    Parameters
    ----------
    once
        Print one snapshot and exit.
    """
    with connect_robot(chosen.robot, "watch") as robot:
        watched = WatchedRobot(robot)
        _first_look(watched)
        try:
            if chosen.as_json:
                _print_lines(watched, once=once)
            elif once or not sys.stdout.isatty():
                show_parts(*snapshot(watched))
            else:
                _show_live(watched)
        except KeyboardInterrupt:
            return 0
        except DxlrunError as error:
            if robot.link.alive:
                raise
            if not chosen.as_json:
                show_parts(
                    f"{robot.name} has ended" if not isinstance(error, Refused) else f"{robot.name} is ending"
                )
    return 0


def _first_look(watched: WatchedRobot) -> None:
    """Request the first data, and wait up to about 2.5 s for the run's first cycle."""
    from dxlrun.channels.answers import Code

    for _ in range(50):
        try:
            watched.poll_robot()
        except Refused as refused:
            if refused.code != Code.NO_CYCLE:
                raise
            time.sleep(REFRESH_S / 4)
        else:
            return
    watched.poll_robot()


def _print_lines(watched: WatchedRobot, *, once: bool) -> None:
    show_json(watched.json())
    while not once:
        time.sleep(REFRESH_S)
        watched.poll_robot()
        show_json(watched.json())


def _show_live(watched: WatchedRobot) -> None:
    """Redraw the view until the key q is pressed; raises DxlrunError when the robot is gone."""
    from rich.live import Live

    console = out()
    with keys_pressed() as pressed, Live(console=console, screen=True, auto_refresh=False) as live:
        while True:
            width, height = console.size
            # A line of full width may wrap.
            live.update(view(watched, width - 1, height), refresh=True)
            if pressed(REFRESH_S):
                return
            watched.poll_robot()


# Tables and lines


def headline(watched: WatchedRobot) -> Sentence:
    """Return a line about the run: rate, cycle, delay of the wake-up and skipped periods."""
    info, late = watched.info, watched.states.late_ns * 1e-9
    rate = "" if watched.rate is None else f" ({watched.rate:.1f})"
    paused = ", paused" if info["paused"] else ""
    skipped = info["skipped"]
    text = (
        f"{watched.robot.name}: {info['rate']:g} Hz{rate}{paused}, cycle {watched.states.cycle}, "
        f"late {late * 1e3:.2f} ms (max {watched.latest * 1e3:.2f}), {skipped} skipped"
    )
    return Sentence(text, "warning" if skipped or paused else "plain")


def joints(watched: WatchedRobot) -> Table:
    """Return a table of joints: goal, position, velocity, effort, temperature, voltage, torque or error."""
    numbers = (Column(name) for name in ("goal", "deg", "deg/s", "effort", "deg C", "V"))
    columns = [Column("joint", "name"), *numbers, Column("torque", "name")]
    states = watched.states
    rows = zip(states.joints, states.effort_units, states.units, strict=True)
    return Table.from_rows(
        "", columns, (_joint(name, states.joint(name), unit, JointUnit(way)) for name, unit, way in rows)
    )


def _joint(name: str, row: Row, effort: str, unit: JointUnit) -> list[Cell | str]:
    torque = str(row["torque"])
    tone = _TONES.get(torque, "plain")
    if error := row["hardware_error"]:
        torque, tone = f"{torque} error {error:#04x}", "error"
    elif not row["valid"] and torque != "lost":
        torque, tone = f"{torque} silent", "warning"
    goal, speed = row["goal_position"], row["goal_velocity"]
    factor, way = unit.factor, unit.suffix
    return [
        name,
        _number(goal, factor, 1, way) if goal is not None else _number(speed, factor, 1, f"{way}/s"),
        _number(row["position"], factor, 1, way),
        _number(row["velocity"], factor, 1, way and f"{way}/s"),
        _number(row["effort"], 1.0, 2, f" {effort}") if effort else _number(row["effort"], 100.0, 0, " %"),
        _number(row["temperature"], 1.0, 0),
        _number(row["voltage"], 1.0, 1),
        Cell(torque, tone),
    ]


def _number(value: object, factor: float, digits: int, unit: str = "") -> str:
    if not isinstance(value, int | float):
        return ""
    text = f"{value * factor:.{digits}f}"
    return f"{text.lstrip('-') if float(text) == 0 else text}{unit}"


def sources(watched: WatchedRobot) -> Table:
    """Return a table of devices, sensors and controllers that provide states, with states and age."""
    columns = [Column("source", "name"), Column("age"), Column("states", "text")]
    rows = []
    for name in watched.states.sources:
        empty: Row = {"valid": False, "age": None, "states": {}, "units": {}}
        row = cast("Row", watched.states.source(name) or empty)
        said = (
            f"{key} {quantity_text(one, row['units'].get(key, ''), digits=4)}"
            for key, one in row["states"].items()
        )
        rows.append((name, _age(row), ", ".join(said)))
    return Table.from_rows("", columns, rows)


def _age(row: Row) -> Cell:
    age = row["age"]
    if not isinstance(age, int | float):
        return Cell("no states", "warning")
    text = f"{age * 1e3:.0f} ms"
    # The same text as in `dxlrun get`.
    return Cell(text) if row["valid"] else Cell(f"{text}, not valid", "warning")


def controllers(watched: WatchedRobot) -> Table:
    """Return a table of controllers: state, rate, duration of the last update, and controllers they
    command.
    """
    updates = dict(zip(watched.states.controllers, watched.states.controller_ns.tolist(), strict=True))
    columns: Columns[Row] = [
        (Column("controller", "name"), "name"),
        (Column("state", "name"), lambda one: Cell(state(one), "good" if one["active"] else "plain")),
        (Column("rate", form="{:g} Hz"), "rate"),
        (Column("update", form="{:.0f} us"), lambda one: updates.get(one["name"], 0) * 1e-3 or None),
        (Column("into", "text"), lambda one: ", ".join(one.get("into", ()))),
    ]
    return Table.listing("", columns, watched.info["controllers"])


def event_lines(watched: WatchedRobot, most: int) -> list[Sentence]:
    """Return lines for the last `most` events, the newest one last, with their age."""
    lines = []
    # Of the loop's commands, the run itself gives only the pause in which it waits for its gateway.
    shown = [event for event in watched.events if event["origin"] != OWN_ORIGIN]
    for event in shown[-most:] if most > 0 else []:
        severity = event["severity"]
        tone: Tone = "error" if severity >= 40 else "warning" if severity >= 30 else "plain"
        text = " ".join(str(event["text"]).split())
        ago = watched.states.time_ns * 1e-9 - event["time"]
        lines.append(Sentence(f"{ago:5.1f} s ago, {event['source']}: {text}", tone))
    return lines


def snapshot(watched: WatchedRobot) -> tuple[Table | Sentence, ...]:
    """Return the lines and tables of one snapshot, for a pipe."""
    others = sources(watched)
    between = (others,) if others.rows else ()
    return (
        headline(watched),
        joints(watched),
        *between,
        controllers(watched),
        *event_lines(watched, 10),
    )


def view(watched: WatchedRobot, width: int, height: int) -> Group:
    """Return the view for a terminal of this size, columns and lines: all joints, and what fits of the
    rest.
    """
    from rich.console import Group

    head, rows, other = headline(watched), joints(watched), controllers(watched)
    left = height - 2 - len(rows.rows)
    parts: list[RenderableType] = [_line(head, width), compact(rows)]
    between = sources(watched)
    if between.rows and left >= len(between.rows) + 2:
        parts.append(compact(between))
        left -= len(between.rows) + 1
    if left >= len(other.rows) + 2:
        parts.append(compact(other))
        left -= len(other.rows) + 1
    elif left > 0:
        active = [row[0].text for row in other.rows if row[1].text != "inactive"]
        parts.append(_line(Sentence(f"active: {', '.join(active)}"), width))
        left -= 1
    parts += [_line(one, width) for one in event_lines(watched, left)]
    return Group(*parts)


def _line(sentence: Sentence, width: int) -> Text:
    from rich.text import Text

    text = Text(escaped(sentence.text), style=STYLES[sentence.tone], no_wrap=True, overflow="ellipsis")
    text.truncate(width, overflow="ellipsis")
    return text
