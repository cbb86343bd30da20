"""Problems of a robot file of valid form: collected by all checks, each at its place in the file."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

from dxlrun.description.document import KeyPath
from dxlrun.description.reading import Description
from dxlrun.errors import InputError, Mark, Problem, told_once


class Problems:
    """All problems of one compilation. A check adds its problems and continues."""

    __slots__ = ("_found", "_joints")

    def __init__(self, joints: Collection[str] = ()) -> None:
        """Start without problems.

        Args:
            joints: Joints that can share a mistake in their defaults, which is reported once.
        """
        self._found: list[Problem] = []
        self._joints = joints

    def error(self, mark: Mark, what: str, fix: str) -> None:
        """Add a problem that prevents the run."""
        self._found.append(Problem(mark, what, fix))

    def warning(self, mark: Mark, what: str, fix: str) -> None:
        """Add a problem that a person should look at; the robot can run."""
        self._found.append(Problem(mark, what, fix, severity="warning"))

    def extend(self, problems: Iterable[Problem]) -> None:
        """Add the problems of another check."""
        self._found.extend(problems)

    @property
    def errors(self) -> tuple[Problem, ...]:
        """Errors in file order."""
        return self._of("error")

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """Warnings in file order."""
        return self._of("warning")

    def _of(self, severity: str) -> tuple[Problem, ...]:
        found = told_once((one for one in self._found if one.severity == severity), self._joints)
        return tuple(sorted(found, key=lambda problem: problem.mark))

    def refuse(self) -> None:
        """Raise InputError with the errors, followed by the warnings, if there is any error."""
        if self.errors:
            raise InputError(self.errors + self.warnings)


class RobotFile(Problems):
    """A robot file under compilation: its values, their places, and the problems."""

    __slots__ = ("description", "marks", "robot")

    def __init__(self, description: Description) -> None:
        super().__init__(description.robot.joints)
        self.description = description
        self.robot = description.robot
        self.marks = description.marks

    def at(self, *path: str | int) -> Mark:
        """Return the place of a value, or of its nearest parent in the file."""
        return self.marks.value(*path)

    def key(self, *path: str | int) -> Mark:
        """Return the place of a key, of a list item, or of the nearest parent."""
        return self.marks.key(*path)


def joint_mark(description: Description, controller: str, joint: str) -> Mark:
    """Return the last place where a controller of the file names a joint, else the controller's own place."""
    start = ("controllers", controller)
    parameters = description.robot.controllers[controller].parameters
    named = [path for path, text in _texts(parameters, start) if text == joint]
    return description.marks.value(*named[-1]) if named else description.marks.key(*start)


def into_mark(description: Description, controller: str, index: int) -> Mark:
    """Return the place where a controller names an entry of `into`, which can be a list or one name."""
    at: KeyPath = ("controllers", controller, "into")
    return (
        description.marks.value(*at, index)
        if description.marks.has((*at, index))
        else description.marks.value(*at)
    )


def _texts(value: object, path: KeyPath) -> Iterator[tuple[KeyPath, str]]:
    """Yield every text of a tree with its path."""
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _texts(item, (*path, str(key)))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _texts(item, (*path, index))
