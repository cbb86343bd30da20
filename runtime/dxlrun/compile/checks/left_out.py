"""Left out: what cross checks may say of a robot file of which some parts have a wrong form.

Those parts were reported already and are left out of the description, or guessed where a robot needs them,
so that mistakes of form and of meaning come together. What points at a part that was left out is skipped.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from dxlrun.compile.checks.places import policy_marks, pose_marks, texts
from dxlrun.description import Description
from dxlrun.errors import Mark, Problem


def left_out_names(description: Description, section: str) -> tuple[str, ...]:
    """Return the names of the entries of a section (buses, joints, controllers) that were left out."""
    return tuple(str(path[1]) for path in description.left_out if len(path) == 2 and path[0] == section)


def still_true(description: Description, problems: Iterable[Problem]) -> tuple[Problem, ...]:
    """Return the errors that have nothing to do with what was left out."""
    silent = set(_silent(description))
    return tuple(p for p in problems if p.severity == "error" and p.mark not in silent)


def _silent(description: Description) -> Iterator[Mark]:
    robot, marks = description.robot, description.marks
    buses, joints = left_out_names(description, "buses"), left_out_names(description, "joints")
    for name, joint in robot.joints.items():
        if joint.bus in buses or ("buses",) in description.left_out:
            yield marks.value("joints", name, "bus")
    for name, pose in robot.poses.items():
        yield from (marks.key("poses", name, joint) for joint in pose if joint in joints)
    poses = ("poses",) in description.left_out or left_out_names(description, "poses")
    if poses:
        yield from pose_marks(description)
    if poses or joints:
        yield from policy_marks(description)  # they may be short without what was left out
    yield from (
        marks.value("controllers", name, "fallback")
        for name, controller in robot.controllers.items()
        if controller.fallback in left_out_names(description, "controllers")
    )
    for name, controller in robot.controllers.items():
        for path, text in texts(controller.parameters, ("controllers", name)):
            if text in joints:
                yield marks.value(*path)
