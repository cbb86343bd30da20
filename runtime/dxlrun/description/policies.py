"""Policies: what happens when something does not go on as planned, as the robot file says it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from dxlrun.description.form import Form, Name
from dxlrun.description.units import AngularVelocity, Duration


class PoseStep(Form):
    """A step of a policy: to a pose."""

    pose: str = Field(min_length=1, description="Name of a pose.", examples=["home"])
    speed: Annotated[AngularVelocity, Field(gt=0)] = Field(
        description="How fast each joint goes there.", examples=["60 deg/s"]
    )


class TorqueStep(Form):
    """A step of a policy: less torque, little by little."""

    reduce_torque: float = Field(
        gt=0, lt=1, description="What is left of each servo's own torque limit.", examples=["0.3"]
    )
    steps: int = Field(default=5, ge=1, le=100, description="In how many steps.", examples=["5"])
    over: Annotated[Duration, Field(gt=0)] = Field(
        default=1_000_000_000, description="How long it takes.", examples=["1 s"]
    )


Word = Literal["limp", "hold"]
"""Torque off; or torque on, every joint where it is."""


def _kind_of_step(step: object) -> str:
    if isinstance(step, dict):
        return "<torque>" if "reduce_torque" in step else "<pose>"
    if isinstance(step, TorqueStep):
        return "<torque>"
    return "<pose>" if isinstance(step, PoseStep) else "<word>"


def _kind_of_policy(policy: object) -> str:
    return "<steps>" if isinstance(policy, list | tuple | dict) else "<word>"


PolicyStep = Annotated[
    Annotated[Word, Tag("<word>")]
    | Annotated[PoseStep, Tag("<pose>")]
    | Annotated[TorqueStep, Tag("<torque>")],
    Discriminator(_kind_of_step),
]
Policy = Annotated[
    Annotated[Word, Tag("<word>")]
    | Annotated[tuple[PolicyStep, ...], Field(strict=False, min_length=1), Tag("<steps>")],
    Discriminator(_kind_of_policy),
]
"""What is done, in order; after the last step the robot is limp, unless that is `hold`."""


class GroupPolicies(Form):
    """What a group of joints does otherwise than the rest of the robot."""

    joints: Annotated[tuple[Name, ...], Field(strict=False, min_length=1)] = Field(
        description="Its joints; each is in one group at most.", examples=["[left_wheel, right_wheel]"]
    )
    on_lost_servo: Literal["hold", "limp", "stop"] | None = Field(
        default=None,
        description="hold: its controllers wait; limp: the group loses its torque; stop: the run ends.",
        examples=["limp"],
    )
    on_returned_servo: Word | None = Field(
        default=None, description="As the policy of that name, for this group.", examples=["hold"]
    )


class Policies(Form):
    """What happens when something does not go on as planned."""

    on_exit: Policy = Field(
        default="limp",
        description="At the end of a run.",
        examples=["[{pose: home, speed: 60 deg/s}, limp]"],
    )
    on_fault: Policy = Field(
        default="limp", description="When the loop, a bus or a controller failed.", examples=["limp"]
    )
    on_lost_servo: Policy = Field(
        default="hold",
        description="When a servo stopped answering; hold: its controllers wait, the others go on.",
        examples=["hold"],
    )
    on_returned_servo: Word = Field(
        default="limp",
        description="When a servo answers again that has rebooted; hold: it gets torque where it stands.",
        examples=["hold"],
    )
    groups: dict[Name, GroupPolicies] = Field(
        default={},
        description="Groups of joints with policies of their own for lost servos.",
        examples=["{wheels: {joints: [left_wheel, right_wheel], on_lost_servo: limp}}"],
    )
    on_stale_command: Policy = Field(
        default="hold",
        description="When a stream of commands stopped; hold: its joints stay, the run goes on.",
        examples=["hold"],
    )
    exit_timeout: Duration = Field(
        default=2_000_000_000, gt=0, description="Longest orderly end of a run.", examples=["2 s"]
    )
