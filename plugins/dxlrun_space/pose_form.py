"""Pose of a link: its form, and the joints that have it."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Final, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from dxlrun import Angle, Floats, Length
from dxlrun.tooling.features import PoseStage, SolvedPose
from dxlrun.tooling.files import Form, Name, key
from dxlrun.tooling.robots import Transform, from_rpy

if TYPE_CHECKING:
    from dxlrun_space.chain import Chain

NORM: Final = 1e-3
"""Largest difference of a quaternion's length from 1: three decimals of each number."""


def at_most_a_turn(value: float) -> float:
    """Return an angle, rad; raise ValueError if it is more than a turn."""
    if abs(value) > 2 * math.pi:
        raise ValueError(
            f"{value:g} rad is more than a turn; write at most a turn, with its unit, such as 90deg"
        )
    return value


def rotation_of(
    quaternion: tuple[float, float, float, float] | None, *turns: tuple[float, float, float] | None
) -> tuple[float, float, float, float] | None:
    """Return the given orientation as a quaternion of length 1, or None.

    Raises ValueError for more than one orientation, or a quaternion that is not of length 1.
    """
    given = [each for each in turns if each is not None]
    if len(given) + (quaternion is not None) > 1:
        raise ValueError("several orientations are given; keep one")
    if quaternion is None:
        return from_rpy(given[0]) if given else None
    length, (x, y, z, w) = math.hypot(*quaternion), quaternion
    if abs(length - 1) > NORM:
        raise ValueError(f"the quaternion has length {length:.4g}; scale it to length 1")
    return x / length, y / length, z / length, w / length


_Place = Annotated[Length, Field(ge=-100, le=100)]  # As in the command `pose`
_Turn = Annotated[Angle, AfterValidator(at_most_a_turn)]
_Turns = Annotated[tuple[_Turn, _Turn, _Turn], Field(strict=False)]
_Quaternion = Annotated[tuple[float, float, float, float], Field(strict=False)]


class TipPose(Form):
    """Form of a pose of a link, which becomes positions of the joints that move the link."""

    tip: str = key("Link of the URDF that has the pose.", "gripper_link", min_length=1)
    base: str = key("Link above the tip in whose axes the pose is; empty: the root.", "base_link", "")
    x: _Place = key("Position of the tip.", "20 cm")
    y: _Place = key("Position of the tip.", "0 cm")
    z: _Place = key("Position of the tip.", "15 cm")
    rpy: _Turns | None = key(
        "Roll, pitch and yaw. Without it any orientation. If the joints do not reach it, the nearest one: "
        "`dxlrun check` reports the difference; `orientation` of a `cartesian_controller` may refuse it.",
        "[0 deg, 40 deg, 0 deg]",
        None,
    )
    quaternion: _Quaternion | None = key("Orientation x, y, z, w in place of `rpy`.", "[0, 0, 0, 1]", None)
    near: dict[Name, Angle] = key(
        "Joints of the solution to prefer, where there are several.", "{elbow: 9 deg}", {}
    )

    @model_validator(mode="after")
    def _has_one_orientation(self) -> Self:
        rotation_of(self.quaternion, self.rpy)
        return self


def dexterity(chain: "Chain", postures: Iterable[Sequence[float]]) -> tuple[Floats, Floats]:
    """Return place and dexterity of the tip at joint positions: 1 in all directions alike, 0 singular.

    This is the inverse condition number of the Jacobian of the tip's place (J. K. Salisbury and J. J. Craig,
    "Articulated hands: force control and kinematic issues", 1982).
    """
    places, columns = [], []
    for posture in postures:
        places.append(chain.pose(posture).translation)
        columns.append([column[:3] for column in chain.jacobian()])
    speeds = np.linalg.svd(np.array(columns), compute_uv=False)
    return np.array(places), speeds[:, -1] / np.maximum(speeds[:, 0], 1e-12)


def _solve(pose: TipPose, urdf: str | None, joints: Mapping[str, tuple[float, float]]) -> SolvedPose:
    # Imported here, because most robot files have no pose of a link.
    from dxlrun_space.chain import BASE, WrongChain, chain_of
    from dxlrun_space.path import out_of_reach, remark_on
    from dxlrun_space.solver import Solver, finish_search

    chain = chain_of(urdf, pose.base, pose.tip)
    for joint in pose.near:
        if joint not in chain.joints:
            raise WrongChain("near", f"{joint} does not move {pose.tip}", f"write {', '.join(chain.joints)}")
    if lacking := next((joint for joint in chain.joints if joint not in joints), ""):
        return SolvedPose({}, lacking=lacking)
    lower, upper = zip(*(joints[joint] for joint in chain.joints), strict=True)
    near = [pose.near.get(joint) for joint in chain.joints]
    solver = Solver(chain, lower, upper, near)
    start = tuple(each or 0.0 for each in near)
    rotation = rotation_of(pose.quaternion, pose.rpy)
    target = Transform((pose.x, pose.y, pose.z), rotation or BASE.rotation)
    search = solver.search(target, start, exact=False) if rotation else solver.search_place(target, start)
    found = finish_search(search)
    if not found.residual.suffices(exact=False):
        raise WrongChain("", out_of_reach(found.residual, exact=False), "move the pose")
    return SolvedPose(
        dict(zip(chain.joints, found.positions, strict=True)),
        remark_on(found.residual) if rotation else "",
        {"dexterity": dexterity(chain, [found.positions])[1].item()},
    )


STAGE = PoseStage("tip", TipPose, _solve)
