"""Orientations: warnings if an IMU's data are assigned to different links of the URDF in several places."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from dxlrun.compile.contribution import Contribution
from dxlrun.compile.controller_entry import CompiledController
from dxlrun.compile.problems import RobotFile
from dxlrun.description.frames.tree import FramesPlan
from dxlrun.errors import suggestion
from dxlsim.geometry.transform import NO_TURN, Quaternion, Transform, conjugate, from_rpy, product
from dxlsim.geometry.urdf import Urdf

_ALIKE_RAD = math.radians(1.0)  # orientations this close are meant to be equal [i]


def check_orientations(
    file: RobotFile,
    urdf: Urdf,
    frames: FramesPlan | None,
    contributions: Iterable[Contribution],
    controllers: Mapping[str, CompiledController],
) -> None:
    """Warn if source, message frame, `model.imu_link` and readers put an orientation on different links."""
    links = {name: link for each in contributions for name, link in each.links.items()}
    for name, controller in controllers.items():
        frame, plan = _text(controller, "frame"), controller.plan
        has_vectors = any(state.endswith(".x") for state in plan.provides)
        if frame and plan.reads and has_vectors:
            _check_frame(file, urdf, name, controller, links)
            links[name] = frame
    marks, model = file.marks, file.robot.model
    imu = frames.imu if frames is not None else ""
    if frames is not None and imu in links and (turn := _turn(urdf, frames.imu_link, links[imu])):
        key = "imu_link" if model is not None and model.imu_link else "imu"
        file.warning(
            marks.value("model", key),
            f"{imu} measures in the frame {links[imu]}, but `imu_link` is {frames.imu_link}: {turn}",
            f"write `imu_link: {links[imu]}`, or correct the frame of {imu}",
        )
    if frames is not None and imu:
        links.setdefault(imu, frames.imu_link)
    for name, controller in controllers.items():
        source, _, state = _text(controller, "orientation").partition("/")
        if state and (turn := _turn(urdf, urdf.root, links.get(source, urdf.root))):
            file.warning(
                marks.value("controllers", name, "orientation"),
                f"{source} measures the orientation of {links[source]}, but {name} uses it as that of "
                f"{urdf.root}, the URDF's first link: {turn}",
                f"use the orientation of an IMU on {urdf.root}",
            )


def _check_frame(
    file: RobotFile, urdf: Urdf, name: str, controller: CompiledController, links: Mapping[str, str]
) -> None:
    """Warn if the `frame` of a controller's messages is not the link of its source plus its `mounting`."""
    frame, source = _text(controller, "frame"), controller.plan.reads[0].partition("/")[0]
    mark = file.at("controllers", name, "frame")
    if frame not in urdf.links:
        what = f"the frame {frame} of {name} is not a link of the URDF"
        file.warning(mark, what, suggestion(frame, urdf.links))
    elif links.get(source) in urdf.links:
        mounting = getattr(controller.parameters, "mounting", (0.0, 0.0, 0.0))
        if turn := _turn(urdf, frame, links[source], from_rpy(mounting)):
            file.warning(
                mark,
                f"the frame of {name} is {frame}, but {source} is on {links[source]}: {turn}",
                f"write `frame: {links[source]}`, or the rotation of {source} as `mounting`",
            )


def _text(controller: CompiledController, key: str) -> str:
    """Return a controller's parameter if it is a text; else an empty one."""
    value = getattr(controller.parameters, key, "")
    return value if isinstance(value, str) else ""


def _turn(urdf: Urdf, link: str, other: str, expected: Quaternion = NO_TURN) -> str:
    """Return in words how a link is rotated against another; empty if as `expected` or a link is unknown."""
    if link not in urdf.links or other not in urdf.links:
        return ""
    (above, place), (other_above, other_place) = _fixed(urdf, link), _fixed(urdf, other)
    if above != other_above:
        return "these links move relative to each other"
    found = product(conjugate(place.rotation), other_place.rotation)
    # abs(): q and -q are the same rotation. min(): rounding may lead to more than 1.
    angle = 2 * math.acos(min(1.0, abs(product(conjugate(expected), found)[3])))
    if angle <= _ALIKE_RAD:
        return ""
    mounting = " with the mounting" * (expected != NO_TURN)
    return f"these links differ by {math.degrees(angle):.0f} deg{mounting}"


def _fixed(urdf: Urdf, link: str) -> tuple[str, Transform]:
    """Return the topmost link that is rigidly joined to a link, and the link's pose in it."""
    above = {joint.child: joint for joint in urdf.joints}
    place = Transform()
    while link in above and not above[link].moves:
        joint = above[link]
        place = Transform(joint.xyz, from_rpy(joint.rpy)) @ place
        link = joint.parent
    return link, place
