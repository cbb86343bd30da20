"""Client: a running robot from Python, whose arms go to poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, cast

import dxlrun
from dxlrun import DxlrunError, GoalState, Refused, RemoteRobot

Distance = float | str | None
"""Length in m, or as text with its unit: `"5 cm"`. None: not given."""
Angles = Sequence[float | str] | None
"""Angles in rad, or as texts with their units."""


class PoseRefused(Refused):
    """An arm did not reach a pose: mostly one out of reach, before a joint moved.

    `code` is the outcome of the goal: `aborted`, `missed`, `cancelled`, `preempted`.
    """


class SpaceRobot(RemoteRobot):
    """A running robot whose arms go to poses.

    from dxlrun_space.space_robot import connect

    with connect() as robot:
        robot.move_to(x=0.2, y=0.0, z=0.15)
        robot.move_to(dz="5 cm", seconds=2.0)
    """

    def move_to(
        self,
        arm: str = "",
        *,
        x: Distance = None,
        y: Distance = None,
        z: Distance = None,
        dx: Distance = None,
        dy: Distance = None,
        dz: Distance = None,
        rpy: Angles = None,
        drpy: Angles = None,
        quaternion: Sequence[float] | None = None,
        frame: str = "",
        path: Literal["line", "joints"] = "line",
        seconds: float | None = None,
        timeout: float | None = None,
    ) -> GoalState:
        """Move the tip of an arm to a pose and return when it has arrived.

        Args:
            arm: Name of the `cartesian_controller`; empty: the only one.
            x, y, z, dx, dy, dz, rpy, drpy, quaternion, frame, path, seconds: Fields of its command `pose`.
            timeout: Longest wait, s; None waits without limit.

        Raises:
            PoseRefused: The pose is out of reach, or the motion did not end there.
            Refused: The pose is malformed, or there is no such arm.
            GoalTimeout: The motion has not ended within `timeout`.
        """
        fields = {
            "x": x, "y": y, "z": z, "dx": dx, "dy": dy, "dz": dz, "rpy": rpy, "drpy": drpy,
            "quaternion": quaternion, "frame": frame, "path": path, "seconds": seconds,
        }  # fmt: skip
        pose = {name: value for name, value in fields.items() if value is not None}
        goal = self.send(arm or self._only_arm(), "pose", pose).goal
        if goal is None:
            raise DxlrunError(f"{arm} does not move to poses; name a cartesian_controller")
        state = goal.wait(timeout)
        if state.status != "reached":
            raise PoseRefused(state.describe_outcome(), code=state.status, fields={"goal": state.number})
        return state

    def _only_arm(self) -> str:
        rows = cast("Sequence[Mapping[str, object]]", self.info()["controllers"])
        arms = [str(row["name"]) for row in rows if row["type"] == "cartesian_controller"]
        if len(arms) != 1:
            raise DxlrunError(f"{self.name} has {len(arms)} arms ({', '.join(arms)}); name one")
        return arms[0]


def connect(robot: str | None = None, client: str | None = None) -> SpaceRobot:
    """Connect to a running robot, as `dxlrun.connect`."""
    found = dxlrun.connect(robot, client)
    return SpaceRobot(found.name, found.link)
