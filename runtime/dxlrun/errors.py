"""The exceptions that dxlrun raises, the problems that it reports, and words that their messages share.

```
Exception
└── DxlrunError                    every error that dxlrun raises on purpose; exit code 1
    ├── InputError (ValueError)    a file, an argument or a plug-in is wrong; exit code 2
    │   └── PlugInError (ImportError)   a plug-in is missing, broken on import, or of another contract
    ├── PortError (OSError)        a serial line cannot be opened, or is gone
    ├── StartUpError               a servo differs from the robot file; torque stayed off
    ├── ServoFault                 a servo refused a tool's request, or did not answer
    ├── ControllerFault            a controller raised, or broke its contract
    ├── ProcessFault               a process of the run ended or hung
    ├── Refused                    a running robot refused a request; exit code 2: the request was wrong
    ├── GoalTimeout (TimeoutError) a goal has not ended in the time that was given
    └── LogError (ValueError)      a log or a ledger cannot be read; exit code 2
```
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal


@dataclass(frozen=True, slots=True, order=True)
class Mark:
    """A place in a file that a person can jump to; line and column count from 1."""

    file: str
    line: int = 1
    column: int = 1

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}"


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong with an input: where, what, and how to fix it."""

    mark: Mark
    what: str
    fix: str
    severity: Literal["error", "warning"] = "error"

    def __str__(self) -> str:
        kind = "" if self.severity == "error" else "warning: "
        return f"{self.mark}: {kind}{self.what}; {self.fix}"


def told_once(problems: Iterable[Problem], names: Collection[str]) -> list[Problem]:
    """Return the problems; of those that differ by one of the `names` alone, at one place, the first.

    A default of many joints is one mistake, not one of each joint.
    """
    found: dict[tuple[Mark, str, str], list[Problem]] = {}
    for problem in problems:
        words = re.split(r"(\w+)", problem.what)
        text = "".join("*" if word in names else word for word in words)
        found.setdefault((problem.mark, text, problem.severity), []).append(problem)
    return [
        first
        if not others
        else replace(first, what=f"{first.what} (and {counted(len(others), 'joint', 'joints')} more)")
        for first, *others in found.values()
    ]


class DxlrunError(Exception):
    """Every error that dxlrun raises on purpose; the command line returns its `exit_code`."""

    exit_code = 1

    @property
    def sentences(self) -> tuple[str, ...]:
        """The message, line by line, and the notes that were added to it."""
        return (*str(self).splitlines(), *getattr(self, "__notes__", ()))


class InputError(DxlrunError, ValueError):
    """A file, an argument or a plug-in is wrong; carries every problem that was found, in file order."""

    exit_code = 2

    def __init__(self, problems: Sequence[Problem] | str) -> None:
        self.problems: tuple[Problem, ...] = () if isinstance(problems, str) else tuple(problems)
        text = problems if isinstance(problems, str) else "\n".join(str(problem) for problem in problems)
        super().__init__(text)


class PlugInError(InputError, ImportError):
    """A plug-in is missing, broken on import, or made for another version of the contract."""


class PortError(DxlrunError, OSError):
    """A serial line cannot be opened, is in use by another program, or is gone."""


class Refused(DxlrunError):
    """A running robot refused a request; the message gives the reason and a request that would work.

    `code` names the reason and `fields` are its data, for programs: their names stay, the wording may change.
    """

    def __init__(
        self,
        sentence: str,
        *,
        code: str = "",
        fields: Mapping[str, object] = MappingProxyType({}),
        wrong_input: bool = False,
    ) -> None:
        super().__init__(sentence)
        self.code = code
        self.fields = fields
        self.exit_code = InputError.exit_code if wrong_input else DxlrunError.exit_code


class GoalTimeout(DxlrunError, TimeoutError):
    """A goal has not ended in the time that was given; it goes on."""


class StartUpError(DxlrunError, RuntimeError):
    """A servo differs from the robot file; torque stayed off, or was switched off again."""


class ServoFault(DxlrunError, RuntimeError):
    """A servo refused the request of a tool, or did not answer; the message names it."""


class ControllerFault(DxlrunError, RuntimeError):
    """A controller raised, or broke its contract; the message names the controller and the joint."""


class ProcessFault(DxlrunError, RuntimeError):
    """A process of the run ended, hung, or could not be started."""


class LogError(DxlrunError, ValueError):
    """A log or a ledger cannot be read, or is not one of dxlrun."""

    exit_code = 2


def suggestion(name: str, known: Sequence[str]) -> str:
    """Return how to fix an unknown name: the closest known one, or all of them."""
    import difflib  # not above: only a wrong name needs it

    if not known:
        return "there is none"
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"did you mean {close[0]}?" if close else f"known: {', '.join(sorted(known))}"


def counted(number: int, one: str, many: str) -> str:
    """Return `1 period`, `2 periods`: one form for exactly one, the other for all else, zero included."""
    return f"{number} {one if number == 1 else many}"
