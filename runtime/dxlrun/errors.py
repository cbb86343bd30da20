"""The exceptions that dxlrun raises, the problems that it reports, and words that their messages share.

```
Exception
└── DxlrunError                    every error that dxlrun raises on purpose; exit code 1. It is
    │                              dxlwire's DxlError, so that it includes those of the libraries
    ├── InputError (ValueError)    a file, an argument or a plug-in is wrong; exit code 2
    │   └── PlugInError (ImportError)   a plug-in is missing, broken on import, or of another contract
    ├── PortError (OSError)        a serial line cannot be opened, or is gone
    ├── NotCompiled                a compiled C source is missing; see dxlwire/exceptions.py
    ├── StartUpError               a servo differs from the robot file; torque stayed off
    ├── ServoFault                 a servo refused a tool's request, or did not answer
    ├── ControllerFault            a controller raised, or broke its contract
    ├── ProcessFault               a process of the run ended or hung
    ├── RunGone                    the run ended while a client steered it
    ├── Refused                    a running robot refused a request; exit code 2: the request was wrong
    ├── GoalTimeout (TimeoutError) a goal did not end within its timeout
    └── LogError (ValueError)      a log cannot be read; exit code 2
```
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from importlib.util import find_spec
from types import MappingProxyType

from dxlwire.exceptions import DxlError as DxlrunError
from dxlwire.exceptions import (
    InputError,
    Mark,
    PortError,
    Problem,
    counted,
    help_link,
    near,
    suggestion,
    what_and_fix,
)

__all__ = [
    "ControllerFault",
    "DxlrunError",
    "GoalTimeout",
    "InputError",
    "LogError",
    "Mark",
    "PlugInError",
    "PortError",
    "Problem",
    "ProcessFault",
    "Refused",
    "RunGone",
    "ServoFault",
    "StartUpError",
    "counted",
    "help_link",
    "missing_extra",
    "near",
    "suggestion",
    "told_once",
    "what_and_fix",
]


def told_once(problems: Iterable[Problem], names: Collection[str]) -> list[Problem]:
    """Merge problems that differ only in a joint's name (`names`) at one place into the first, with a count.

    A mistake in the defaults of many joints is one mistake.
    """
    found: dict[tuple[Mark, str, str], list[Problem]] = {}
    for problem in problems:
        words = re.split(r"(\w+)", problem.what)
        text = "".join("*" if word in names else word for word in words)
        found.setdefault((problem.mark, text, problem.severity), []).append(problem)
    return [
        first
        if not others
        else first._replace(what=f"{first.what} (and {counted(len(others), 'joint', 'joints')} more)")
        for first, *others in found.values()
    ]


class PlugInError(InputError, ImportError):
    """A plug-in is missing, fails on import, or is made for another version of dxlrun's contract."""


class Refused(DxlrunError):
    """A running robot refused a request; the message gives the reason and a request that would work.

    `code` names the reason and `fields` are its data, for programs. Their names are stable; the wording may
    change.
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
    """A goal did not end within the client's timeout; the robot still pursues it."""


class StartUpError(DxlrunError, RuntimeError):
    """A servo differs from the robot file at the start of a run, so torque is off.

    `for_replies` is True if replies were late or missing, which a machine that was too busy may have caused.
    """

    def __init__(self, sentences: str, *, for_replies: bool = False) -> None:
        super().__init__(sentences)
        self.for_replies = for_replies


class ServoFault(DxlrunError, RuntimeError):
    """A servo refused a request of a command-line tool, or did not answer; the message names the servo."""


class ControllerFault(DxlrunError, RuntimeError):
    """A controller raised an exception or broke its contract; the message names it and the joint."""


class ProcessFault(DxlrunError, RuntimeError):
    """A process of the run exited, hung, or could not be started."""


class RunGone(DxlrunError):
    """The run ended, or cannot be steered any more, while a client was connected."""


class LogError(DxlrunError, ValueError):
    """A log cannot be read, or the file is not a log of dxlrun."""

    exit_code = 2


def missing_extra(what: str, extra: str, *libraries: str) -> str:
    """Return a sentence about libraries that are not installed, with the command that installs them.

    Returns an empty text if all of them are installed.

    Args:
        what: Feature that needs the libraries.
        extra: Extra of dxlrun with the libraries.
        libraries: Names of the modules.
    """
    missing = [name for name in libraries if find_spec(name) is None]
    if not missing:
        return ""
    names = " and ".join(missing)
    return f"{what} needs {names} (not installed); install it: `pip install 'dxlrun[{extra}]'`"
