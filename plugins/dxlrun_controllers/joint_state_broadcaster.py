"""joint_state_broadcaster: writes the states of all joints into the log, at its own rate."""

from __future__ import annotations

from dxlrun import Controller, Interfaces, ParametersModel


class JointStateBroadcaster(Controller[ParametersModel]):
    """Marks the cycles whose states go to /joint_states; claims nothing, commands nothing."""

    publishes = ("/joint_states",)

    @classmethod
    def interfaces(cls, parameters: ParametersModel, joints: tuple[str, ...]) -> Interfaces:
        """Return all joints of the robot, none of them claimed."""
        return Interfaces(joints)

    def update(self, time_ns: int, period_ns: int) -> None:
        """Mark this cycle."""
        self.context.publish()
