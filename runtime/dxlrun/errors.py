"""The exceptions that dxlrun raises, and the problems that it reports.

```
Exception
└── DxlrunError                    anything dxlrun says on purpose; exit code 1
    ├── InputError (ValueError)    a file, an argument or a plug-in is wrong; exit code 2
    │   └── PlugInError (ImportError)   a plug-in is missing, broken on import, or of another contract
    ├── PortError (OSError)        a serial line cannot be opened, or is gone
    ├── StartUpError               a servo is not what the robot file says; no torque was given
    ├── ServoFault                 a servo does not do what a tool asks, or is not there
    ├── ControllerFault            a controller raised, or broke its contract
    ├── ProcessFault               a process of the run ended or hung
    ├── Refused                    a running robot does not do what it was asked; 2: a wrong wish
    └── LogError (ValueError)      a log or a ledger cannot be read; exit code 2
```
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
    """One thing that is wrong with an input: where, what, and how to mend it."""

    mark: Mark
    what: str
    mend: str
    severity: Literal["error", "warning"] = "error"

    def __str__(self) -> str:
        kind = "" if self.severity == "error" else "warning: "
        return f"{self.mark}: {kind}{self.what}; {self.mend}"


class DxlrunError(Exception):
    """Anything dxlrun says on purpose; `exit_code` is what the command line returns."""

    exit_code = 1

    @property
    def sentences(self) -> tuple[str, ...]:
        """What a person is told: the message, line by line, and the notes that were added on the way."""
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
    """A serial line cannot be opened, is held by somebody else, or is gone."""


class Refused(DxlrunError):
    """A running robot does not do what it was asked; the message says why, and how to ask better."""

    def __init__(self, sentence: str, *, wrong_input: bool = False) -> None:
        super().__init__(sentence)
        self.exit_code = InputError.exit_code if wrong_input else DxlrunError.exit_code


class StartUpError(DxlrunError, RuntimeError):
    """A servo is not what the robot file says; no torque was given, or what was given was taken back."""


class ServoFault(DxlrunError, RuntimeError):
    """A servo does not do what a tool asks of it, or is not there; the message names it."""


class ControllerFault(DxlrunError, RuntimeError):
    """A controller raised, or broke its contract; the message names the controller and the joint."""


class ProcessFault(DxlrunError, RuntimeError):
    """A process of the run ended, hung, or could not be started."""


class LogError(DxlrunError, ValueError):
    """A log or a ledger cannot be read, or is not one of dxlrun."""

    exit_code = 2
