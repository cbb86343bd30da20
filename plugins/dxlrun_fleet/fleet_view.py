"""Fleet view: the last reply of each robot, polled by one thread per robot so that none delays another."""

from __future__ import annotations

import threading
import time
from datetime import datetime

import msgspec
import numpy as np

from dxlrun import DxlrunError, Refused, RemoteRobot
from dxlrun.tooling.live import Address, Events, NetworkLink, RobotInfo
from dxlrun.tooling.output import Cell, Column, Columns, Table

LOOK_S = 0.5  # Polling interval
SILENT_S = 1.5
"""A robot that has not replied for this time is unreachable."""
_ERROR = 40
"""Least severity of an error event."""


class Seen(msgspec.Struct, frozen=True):
    """State of one robot at its last reply."""

    robot: str
    state: str = "connecting"
    """connecting, starting, running, paused, unreachable"""
    since: str = ""
    """Wall-clock time of the last reply of an unreachable robot, or of the first attempt."""
    reason: str = ""
    voltage: float | None = None
    """Lowest voltage of its servos, V"""
    temperature: float | None = None
    """Highest temperature of its servos, deg C"""
    hottest: str = ""
    error: str = ""
    """Text of its last error."""
    log: str | None = None


class RobotView:
    """Poller of one robot, twice a second."""

    def __init__(self, name: str, address: Address) -> None:
        self._address = address
        self._seen = Seen(name)
        self._replied = time.monotonic()
        self.tried = threading.Event()
        """Set once the first poll has succeeded or failed."""
        self._ended = threading.Event()
        threading.Thread(target=self._look_on, daemon=True).start()

    def close(self) -> None:
        """Stop polling, without waiting for a robot that hangs."""
        self._ended.set()

    def seen(self) -> Seen:
        """Return the current state of the robot."""
        seen, silent = self._seen, time.monotonic() - self._replied
        if seen.state != "unreachable" and silent <= SILENT_S:
            return seen
        since = datetime.fromtimestamp(time.time() - silent).astimezone().isoformat(timespec="seconds")
        reason = seen.reason or "it does not answer"
        return msgspec.structs.replace(
            seen, state="unreachable", since=since, reason=reason, voltage=None, temperature=None, hottest=""
        )

    def _look_on(self) -> None:
        while not self._ended.wait(LOOK_S if self.tried.is_set() else 0.0):
            try:
                with RemoteRobot(self._seen.robot, NetworkLink(self._address, "dxlrun fleet")) as robot:
                    last = 0
                    while not self._ended.wait(LOOK_S if last else 0.0):
                        last = self._look(robot, last)
                        self._replied = time.monotonic()
                        self.tried.set()
            except (DxlrunError, OSError, ValueError) as error:
                self._seen = msgspec.structs.replace(self._seen, state="unreachable", reason=str(error))
            self.tried.set()

    def _look(self, robot: RemoteRobot, last: int) -> int:
        """Poll the robot; return the number of its last event."""
        info = msgspec.convert(robot.info(), RobotInfo)
        events = msgspec.convert(robot.events(last), Events)
        errors = [event.text for event in events.events if event.severity >= _ERROR]
        seen = msgspec.structs.replace(
            self._seen,
            state="paused" if info.paused else "running",
            reason="",
            log=info.log,
            error=errors[-1] if errors else self._seen.error if last else "",
        )
        try:
            states = robot.states()
        except Refused as refused:
            if refused.code != "no_cycle":
                raise
            self._seen = msgspec.structs.replace(seen, state="starting")
            return events.last
        hottest = _at_most(states.temperature)
        lowest = _at_most(-states.voltage)
        self._seen = msgspec.structs.replace(
            seen,
            voltage=None if lowest is None else float(states.voltage[lowest]),
            temperature=None if hottest is None else float(states.temperature[hottest]),
            hottest="" if hottest is None else states.joints[hottest],
        )
        return events.last


def _at_most(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> int | None:
    """Return the index of the highest value, or None if all are unknown."""
    return int(np.nanargmax(values)) if np.isfinite(values).any() else None


def fleet_table(robots: list[Seen]) -> Table:
    """Return a table with a row for each robot."""
    columns: Columns[Seen] = [
        (Column("robot", "name"), lambda one: one.robot),
        (Column("state", "name"), _state),
        (Column("battery", form="{:.1f} V", missing="-"), lambda one: one.voltage),
        (Column("hottest", form="{:.0f} deg C", missing="-"), lambda one: one.temperature),
        (Column("of", "name", missing="-"), lambda one: one.hottest or None),
        (Column("last error", "text", missing="-"), lambda one: one.reason or one.error or None),
        (Column("log", "text", missing="-", detail=True), lambda one: one.log),
    ]
    return Table.listing("", columns, robots)


def _state(one: Seen) -> Cell:
    if one.state == "unreachable":
        return Cell(f"unreachable since {one.since[11:19]}", "error")
    return Cell(one.state, "good" if one.state == "running" else "warning")
