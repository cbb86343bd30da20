"""Places: where a controller's free-form parameters name something."""

from __future__ import annotations

from collections.abc import Iterator

from dxlrun.description import Description, KeyPath
from dxlrun.errors import Mark


def joint_mark(description: Description, controller: str, joint: str) -> Mark:
    """Return where a controller of the file names a joint last; the controller's own place if nowhere."""
    start = ("controllers", controller)
    parameters = description.robot.controllers[controller].parameters
    named = [path for path, text in texts(parameters, start) if text == joint]
    return description.marks.value(*named[-1]) if named else description.marks.key(*start)


def policy_marks(description: Description) -> Iterator[Mark]:
    """Yield where the policies of the file and their steps stand."""
    for name, policy in description.robot.policies:
        yield description.marks.value("policies", name)
        if isinstance(policy, tuple):
            for index in range(len(policy)):
                yield description.marks.value("policies", name, index)


def pose_marks(description: Description) -> Iterator[Mark]:
    """Yield where the policies of the file name poses."""
    for name, policy in description.robot.policies:
        for index in range(len(policy) if isinstance(policy, tuple) else 0):
            yield description.marks.value("policies", name, index, "pose")


def texts(value: object, path: KeyPath) -> Iterator[tuple[KeyPath, str]]:
    """Yield every text of a tree with its path."""
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from texts(item, (*path, str(key)))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from texts(item, (*path, index))
