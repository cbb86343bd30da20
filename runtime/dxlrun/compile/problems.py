"""Problems: collects the errors and warnings of all checks, each with its line and column in a file."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

from dxlrun.description.document import KeyPath
from dxlrun.description.reading import Description
from dxlrun.errors import InputError, Mark, Problem, told_once


class Problems:
    """List of all errors and warnings of one compilation; a check adds its problems and continues."""

    __slots__ = ("_found", "_joints")

    def __init__(self, joints: Collection[str] = ()) -> None:
        """Start with an empty list.

        Args:
            joints: Joints that can share a mistake in their defaults, which is reported once.
        """
        self._found: list[Problem] = []
        self._joints = joints

    def error(self, mark: Mark, what: str, fix: str) -> None:
        """Add an error, which prevents the run: place, problem, and fix."""
        self._found.append(Problem(mark, what, fix))

    def warning(self, mark: Mark, what: str, fix: str) -> None:
        """Add a warning: place, problem, and fix; the robot can run all the same."""
        self._found.append(Problem(mark, what, fix, severity="warning"))

    def extend(self, problems: Iterable[Problem]) -> None:
        """Add problems that another function returned."""
        self._found.extend(problems)

    @property
    def errors(self) -> tuple[Problem, ...]:
        """All errors, sorted by place in the file, without repetitions."""
        return self._of("error")

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """All warnings, sorted by place in the file, without repetitions."""
        return self._of("warning")

    def _of(self, severity: str) -> tuple[Problem, ...]:
        found = told_once((one for one in self._found if one.severity == severity), self._joints)
        return tuple(sorted(found, key=lambda problem: problem.mark))

    def raise_errors(self) -> None:
        """Raise InputError with all errors and warnings if there is at least one error."""
        if self.errors:
            raise InputError(self.errors + self.warnings)


class RobotFile(Problems):
    """A robot file during compilation: its values, their places in the file, and the problems found."""

    __slots__ = ("description", "marks", "robot")

    def __init__(self, description: Description) -> None:
        super().__init__(description.robot.joints)
        self.description = description
        self.robot = description.robot
        self.marks = description.marks
        self.extend(description.remarks)

    def at(self, *path: str | int) -> Mark:
        """Return line and column of a value; if it is not in the file, those of its nearest parent."""
        return self.marks.value(*path)

    def key(self, *path: str | int) -> Mark:
        """Return line and column of a key or list item; if it is not in the file, of its nearest parent."""
        return self.marks.key(*path)


def joint_mark(description: Description, controller: str, joint: str) -> Mark:
    """Return line and column of a joint's name in a controller's parameters, else of the controller."""
    start = ("controllers", controller)
    parameters = description.robot.controllers[controller].parameters
    named = [path for path, text in _texts(parameters, start) if text == joint]
    return description.marks.value(*named[-1]) if named else description.marks.key(*start)


def into_mark(description: Description, controller: str, index: int) -> Mark:
    """Return line and column of a name in a controller's `into`, which is a list or a single name."""
    at: KeyPath = ("controllers", controller, "into")
    return (
        description.marks.value(*at, index)
        if description.marks.has((*at, index))
        else description.marks.value(*at)
    )


def _texts(value: object, path: KeyPath) -> Iterator[tuple[KeyPath, str]]:
    """Yield every text in nested parameters, with its path."""
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _texts(item, (*path, str(key)))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _texts(item, (*path, index))
