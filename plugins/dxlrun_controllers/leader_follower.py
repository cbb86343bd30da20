"""leader_follower: make joints follow other joints, or positions from another program, with a soft start."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import (
    LIVE,
    Angle,
    AngularVelocity,
    CommandModel,
    Context,
    Controller,
    Duration,
    Floats,
    Interfaces,
    Mistake,
    ParametersModel,
)
from dxlrun_controllers.group import PositionsCommand
from dxlrun_controllers.joint_parameters import (
    clamped,
    commanded_by,
    hold_joints,
    take_shorter_way,
    take_where_heard,
)
from dxlrun_controllers.laws.tracking_law import CLOSING_SPEED


class Pair(ParametersModel):
    """Follower and leader. The follower moves to scale * (leader's position) + offset."""

    joint: str = Field(examples=["right_elbow"])
    """Joint that follows."""
    leader: str = ""
    """Joint that leads. Either all pairs have a leader, or none has: then the joints follow the command
    `positions`."""
    scale: float = 1.0
    """Factor on the leader's position. A negative scale reverses the direction."""
    offset: Angle = 0.0
    """Offset added to the scaled position, rad."""


class LeaderFollowerParameters(ParametersModel):
    """Keys of a leader_follower in the robot file."""

    pairs: Annotated[tuple[Pair, ...], Field(min_length=1)] = Field(
        examples=["[{joint: right_elbow, leader: left_elbow}]"]
    )
    """Pairs, in the order of the values of the command `positions`."""
    command_interface: Literal["position", "posvel"] = "position"
    """`position` commands the position; `posvel` also commands the speed of the leader."""
    speed: Annotated[AngularVelocity, Field(gt=0), LIVE] = 1.0
    """Speed limit of a follower until it has caught up with its leader, rad/s."""
    timeout: Annotated[Duration, Field(gt=0)] = 100_000_000
    """Largest age of a leader's state, or of a command. The joints hold if it is older."""

    def mistakes(self) -> Iterator[Mistake]:
        """Yield pairs of which only some have a leader, keys that need a leader, and joints that lead and
        follow.
        """
        yield from super().mistakes()
        led = {pair.leader for pair in self.pairs if pair.leader}
        if not led and self.command_interface == "posvel":
            yield ("command_interface",), "posvel needs leaders; name the leaders, or use `position`"
        for index, pair in enumerate(self.pairs):
            place = ("pairs", index)
            if led and not pair.leader:
                what = f"{pair.joint} has no leader, unlike other joints"
                yield place, f"{what}; name a leader for every joint, or for none"
            if not led and (pair.scale != 1.0 or pair.offset):
                yield place, "scale and offset need a leader; name a leader, or remove them"
            if pair.scale == 0.0:
                what = "with a scale of 0 the joint does not follow"
                yield (*place, "scale"), f"{what}; write another number, such as -1 to reverse"
            if pair.joint in led:
                yield (*place, "joint"), f"{pair.joint} is leader and follower; remove one of the two"


class LeaderFollower(Controller[LeaderFollowerParameters]):
    """Controller that makes joints follow leaders.

    A follower first approaches its leader at a limited speed. Once it has caught up, its command in a cycle
    is computed from the leader's state of the same cycle. All joints hold their last goals while the state of
    one leader, or the last command, is too old; then they start softly again. A leader can be a joint without
    torque that is moved by hand, or a joint of another controller.
    """

    Parameters = LeaderFollowerParameters
    Commands: ClassVar = {"positions": PositionsCommand}

    @classmethod
    def interfaces(cls, parameters: LeaderFollowerParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the followers, and read the position, velocity and age of the leaders."""
        followers = tuple(pair.joint for pair in parameters.pairs)
        leaders = [pair.leader for pair in parameters.pairs if pair.leader]
        reads = [f"{leader}/{state}" for state in ("position", "velocity", "age") for leader in leaders]
        return Interfaces(followers, commanded_by(parameters.command_interface), reads=tuple(reads))

    @classmethod
    def prepare(
        cls, kind: str, command: CommandModel, parameters: LeaderFollowerParameters
    ) -> NDArray[np.float64]:
        """Return the positions of a command, rad, shape (pairs,).

        Raises:
            ValueError: The joints follow leaders, or the number of positions is wrong.
        """
        if parameters.pairs[0].leader:
            raise ValueError("the joints follow leaders; positions are not accepted")
        return super().prepare(kind, command, parameters)

    def on_configure(self, context: Context) -> None:
        """Allocate all memory that the loop needs."""
        super().on_configure(context)
        pairs, count = self.parameters.pairs, len(context.joints)
        self._led = bool(pairs[0].leader)
        self._scale = np.array([pair.scale for pair in pairs])
        self._offset = np.array([pair.offset for pair in pairs])
        self._lower, self._upper = context.limits.lower, context.limits.upper
        # Without leaders, `reads` is empty and so are these rows.
        self._leader_position, self._leader_velocity, self._leader_age = context.reads.reshape(3, -1)
        self._wanted = np.zeros(count)
        self._wrap = np.array(context.wrap)
        self._in_step = np.zeros(count, dtype=np.bool_)
        self._posvel = self.parameters.command_interface == "posvel"

    def on_activate(self, time_ns: int) -> None:
        """Hold the joints at their last goals until a leader or a command is fresh."""
        hold_joints(self.context)
        self._in_step.fill(False)
        self._unknown = True
        self._commanded_ns = -1
        self._following = self._reported = False

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Set new positions to follow, and note the time for `timeout`."""
        np.copyto(self._wanted, data)
        self._commanded_ns = time_ns

    def update(self, time_ns: int, period_ns: int) -> None:
        """Move each joint towards its leader's position, with a limited step until it has caught up; else
        hold.
        """
        if self.context.states.has_lost:
            hold_joints(self.context)
            self._in_step.fill(False)
        if self._unknown:
            self._unknown = take_where_heard(self.context.commands.position, self.context.states)
        age_s = self._age_s(time_ns)
        if not age_s <= self.parameters.timeout * 1e-9:
            self._rest(age_s)
            return
        self._following, self._reported = True, False
        if self._led:
            self._wanted = self._leader_position * self._scale + self._offset
        position, reach = self.context.commands.position, self.parameters.speed * period_ns * 1e-9
        wanted = take_shorter_way(self._wanted, position, self._wrap)
        reachable = clamped(wanted, self._lower, self._upper)
        step = reachable - position
        self._in_step |= np.abs(step) <= reach
        step = clamped(step, -reach, reach)
        np.copyto(position, np.where(self._in_step, reachable, position + step))
        if self._posvel:
            self._command_speed(step)

    def _age_s(self, time_ns: int) -> float:
        """Return the age of the oldest leader's state, or of the last command, s; NaN while there is none."""
        if self._led:
            return float(np.maximum.reduce(self._leader_age))  # NaN if one leader has not answered yet
        return (time_ns - self._commanded_ns) * 1e-9 if self._commanded_ns >= 0 else np.nan

    def _rest(self, age_s: float) -> None:
        """Hold the joints, and report once why: `age_s` is above the timeout.

        Before the first command, report nothing.
        """
        if self._following:
            self._in_step.fill(False)
            if self._posvel:
                self._close_in()
        self._following = False
        if self._reported or (not self._led and self._commanded_ns < 0):
            return
        self._reported = True
        if not self._led:
            self.context.say(f"no positions for {age_s:.2f} s, holding")
            return
        worst = int(np.argmax(np.where(np.isnan(self._leader_age), np.inf, self._leader_age)))
        leader = self.parameters.pairs[worst].leader
        since = "yet" if np.isnan(age_s) else f"for {age_s:.2f} s"
        self.context.say(f"no reply from leader {leader} {since}, holding")

    def _command_speed(self, step: Floats) -> None:
        """Command the leader's speed to joints that have caught up, and the approach speed to the others."""
        leading, approach = self._leader_velocity * self._scale, self.parameters.speed
        if self.context.into:  # a reference, with its sign
            velocity = np.where(self._in_step, leading, np.copysign(approach, step))
        else:
            velocity = np.where(self._in_step, np.maximum(np.abs(leading), CLOSING_SPEED), approach)
        np.copyto(self.context.commands.velocity, velocity)

    def _close_in(self) -> None:
        self.context.commands.velocity.fill(0.0 if self.context.into else CLOSING_SPEED)
