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


class SpaceRobot(RemoteRobot):
    """A running robot whose arms go to poses.

    from dxlrun_space.space_robot import connect

    with connect() as robot:
        robot.move_to(x=0.2, y=0.0, z=0.15)
        robot.move_to(dz="5 cm", seconds=2.0)
        robot.move_to(pose="above")
    """

    def move_to(
        self,
        arm: str = "",
        *,
        pose: str | None = None,
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
        path: Literal["line", "joints"] | None = None,
        seconds: float | None = None,
        timeout: float | None = None,
    ) -> GoalState:
        """Move the tip of an arm to a pose and return when it has arrived.

        Args:
            arm: Name of the `cartesian_controller`; empty: the only one.
            pose: Name of a pose of the robot file, in place of coordinates.
            x, y, z, dx, dy, dz, rpy, drpy, quaternion, frame, path, seconds: Fields of its command `pose`.
            timeout: Longest wait, s; None waits without limit.

        Raises:
            Refused: The arm is unknown, the pose is malformed (`code` is `invalid`) or out of reach
                (`goal_refused`), or the motion did not end there (`aborted`, `missed`, `cancelled` or
                `preempted`).
            GoalTimeout: The motion has not ended within `timeout`.
            DxlrunError: The robot has no arm, or several and none is named, or is gone.
        """
        fields = {
            "pose": pose, "x": x, "y": y, "z": z, "dx": dx, "dy": dy, "dz": dz, "rpy": rpy, "drpy": drpy,
            "quaternion": quaternion, "frame": frame, "path": path, "seconds": seconds,
        }  # fmt: skip
        given = {name: value for name, value in fields.items() if value is not None}
        arms = [arm] if arm else self._arms()
        if len(arms) != 1:
            fix = (
                f"name one of {', '.join(arms)}" if arms else "add a `cartesian_controller` to its robot file"
            )
            raise DxlrunError(f"{self.name} has {len(arms) or 'no'} arms that move to poses; {fix}")
        (goal,) = self.send(arms[0], "pose", given).goals
        state = goal.wait(timeout)
        if state.status != "reached":
            raise Refused(state.describe_outcome(), code=state.status, fields={"goal": state.number})
        return state

    def _arms(self) -> list[str]:
        """Return the names of the controllers that take a pose as a goal."""
        rows = cast("Sequence[Mapping[str, Sequence[str]]]", self.info()["controllers"])
        return [str(row["name"]) for row in rows if "pose" in row["goals"]]


def connect(robot: str | None = None, client: str | None = None) -> SpaceRobot:
    """Connect to a running robot, as `dxlrun.connect`."""
    found = dxlrun.connect(robot, client)
    return SpaceRobot(found.name, found.link)
