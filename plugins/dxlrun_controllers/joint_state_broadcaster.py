"""joint_state_broadcaster: write the states of all joints into the log, at its own rate."""

from __future__ import annotations

from dxlrun import Controller, Interfaces, ParametersModel


class JointStateBroadcaster(Controller[ParametersModel]):
    """Controller that publishes the joint states to /joint_states at its own rate. It commands nothing."""

    publishes = ("/joint_states",)

    @classmethod
    def interfaces(cls, parameters: ParametersModel, joints: tuple[str, ...]) -> Interfaces:
        """Read all joints of the robot and claim none."""
        return Interfaces(joints)

    def update(self, time_ns: int, period_ns: int) -> None:
        """Publish the states of this cycle."""
        self.context.publish()
