"""Live table of `dxlrun fleet`: the last reply of each robot, polled by one thread per robot."""

from __future__ import annotations

import threading
import time
from datetime import datetime

import msgspec
import numpy as np

from dxlrun import DxlrunError, Refused, RemoteRobot
from dxlrun.tooling.live import Address, Events, NetworkLink, RobotInfo
from dxlrun.tooling.output import Cell, Column, Columns, Table

LOOK_S = 0.5  # Polling interval of each robot
SILENT_S = 1.5
"""Time without a reply after which the table shows a robot as unreachable, s."""
_ERROR = 40
"""Lowest severity of an event that the table shows as an error (warnings are below)."""


class RobotStatus(msgspec.Struct, frozen=True):
    """Row of the fleet table: one robot at its last reply."""

    robot: str
    state: str = "connecting"
    """connecting, starting (no cycle yet), running, paused or unreachable."""
    since: str = ""
    """Only of an unreachable robot: ISO 8601 local time of its last reply, or of the first attempt."""
    reason: str = ""
    """Only of an unreachable robot: error of the last attempt."""
    voltage: float | None = None
    """Lowest voltage of the robot's servos, V; None if unknown."""
    temperature: float | None = None
    """Highest temperature of the robot's servos, deg C; None if unknown."""
    hottest: str = ""
    """Joint whose servo has this temperature."""
    error: str = ""
    """Text of the run's last event that is an error; empty without one."""
    log: str | None = None
    """Log file that the run writes."""


class RobotView:
    """Thread that polls one robot twice a second over the network, and reconnects after an error."""

    def __init__(self, name: str, address: Address) -> None:
        self._address = address
        self._seen = RobotStatus(name)
        self._replied = time.monotonic()
        self.tried = threading.Event()
        """Set once the first poll has succeeded or failed."""
        self._ended = threading.Event()
        threading.Thread(target=self._look_on, daemon=True).start()

    def close(self) -> None:
        """Stop polling, without waiting for a robot that hangs."""
        self._ended.set()

    def seen(self) -> RobotStatus:
        """Return the robot's row at its last reply; unreachable and without measurements after SILENT_S."""
        seen, silent = self._seen, time.monotonic() - self._replied
        if seen.state != "unreachable" and silent <= SILENT_S:
            return seen
        since = datetime.fromtimestamp(time.time() - silent).astimezone().isoformat(timespec="seconds")
        reason = seen.reason or "no answer"
        return msgspec.structs.replace(
            seen, state="unreachable", since=since, reason=reason, voltage=None, temperature=None, hottest=""
        )

    def _look_on(self) -> None:
        while not self._ended.wait(LOOK_S if self.tried.is_set() else 0.0):
            try:
                with RemoteRobot(self._seen.robot, NetworkLink(self._address, "dxlrun fleet")) as robot:
                    last = 0
                    while not self._ended.wait(LOOK_S if last else 0.0):
                        last = self._poll_robot(robot, last)
                        self._replied = time.monotonic()
                        self.tried.set()
            except (DxlrunError, OSError, ValueError) as error:
                self._seen = msgspec.structs.replace(self._seen, state="unreachable", reason=str(error))
            self.tried.set()

    def _poll_robot(self, robot: RemoteRobot, last: int) -> int:
        """Poll the robot's state and its events after number `last`; return the number of its last event."""
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
    """Return the index of the highest value, or None if none is finite."""
    return int(np.nanargmax(values)) if np.isfinite(values).any() else None


def fleet_table(robots: list[RobotStatus]) -> Table:
    """Return the table of `dxlrun fleet`: state, battery, hottest servo, last error and log of each robot."""
    columns: Columns[RobotStatus] = [
        (Column("robot", "name"), lambda one: one.robot),
        (Column("state", "name"), _state),
        (Column("battery", form="{:.1f} V", missing="-"), lambda one: one.voltage),
        (Column("hottest", form="{:.0f} deg C", missing="-"), lambda one: one.temperature),
        (Column("of", "name", missing="-"), lambda one: one.hottest or None),
        (Column("last error", "text", missing="-"), lambda one: one.reason or one.error or None),
        (Column("log", "text", missing="-", detail=True), lambda one: one.log),
    ]
    return Table.listing("", columns, robots)


def _state(one: RobotStatus) -> Cell:
    if one.state == "unreachable":
        return Cell(f"unreachable since {one.since[11:19]}", "error")
    return Cell(one.state, "good" if one.state == "running" else "warning")
