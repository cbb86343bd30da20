"""Exception hierarchy, including the errors of files and serial lines, and helpers for messages.

```
Exception
└── DxlError                       every error that is raised on purpose; exit code 1
    ├── InputError (ValueError)    a file or an argument is wrong; exit code 2
    ├── NotCompiled                a compiled C source is missing; the installation is broken
    ├── PortError (OSError)        a serial line cannot be opened, or is gone
    └── ServoError                 servos did not answer, or refused
```
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

HELP = "https://example.org/dxlrun/how-to/it-does-not-work"
"""Address of the page "It does not work": a placeholder that a maintainer sets here, as `Issues` in
pyproject.toml. A constant, because messages are also made in the loop, which reads no files."""


# A dataclass takes longer to import, and every command imports this module.
class Mark(NamedTuple):
    """Position in a file, printed as `file:line:column`, to which editors can jump; line and column count
    from 1. The line is 0 in a source without lines, such as the command line."""

    file: str
    line: int = 1
    column: int = 1

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file


class Problem(NamedTuple):
    """One problem in an input file, with its position and the fix."""

    mark: Mark
    what: str
    fix: str
    severity: Literal["error", "warning"] = "error"

    def __str__(self) -> str:
        kind = "" if self.severity == "error" else "warning: "
        return f"{self.mark}: {kind}{self.what}; {self.fix}"


def what_and_fix(sentence: object) -> tuple[str, str]:
    """Return the parts of a text or error of the form `problem; fix`; without a fix, that part is empty.

    Validators raise a ValueError of this form, also those of plug-ins.
    """
    what, _, fix = str(sentence).partition("; ")
    return what, fix


class DxlError(Exception):
    """Base class of every error that is raised on purpose, here and in the packages that build on dxlwire.

    A command that fails with it exits with `exit_code`."""

    exit_code = 1

    @property
    def sentences(self) -> tuple[str, ...]:
        """Lines of the error's message, followed by the notes that were added to the exception."""
        return (*str(self).splitlines(), *getattr(self, "__notes__", ()))


class InputError(DxlError, ValueError):
    """A file or an argument of the user is wrong. `problems` contains all problems in file order; empty if
    only a text was given."""

    exit_code = 2

    def __init__(self, problems: Sequence[Problem] | str) -> None:
        self.problems: tuple[Problem, ...] = () if isinstance(problems, str) else tuple(problems)
        text = problems if isinstance(problems, str) else "\n".join(str(problem) for problem in problems)
        super().__init__(text)


class NotCompiled(DxlError, RuntimeError):
    """The shared object of a C source is missing, or was compiled from another source than the installed
    one."""


class PortError(DxlError, OSError):
    """A serial line cannot be opened, is in use by another program, or was lost during use."""


FailureKind = Literal["no_reply", "refused", "torque_on", "not_written", "wrong_model", "unknown_model"]


class ServoFailure(NamedTuple):
    """Failure of one servo: its kind, for programs, and a sentence for people."""

    kind: FailureKind
    text: str


class ServoError(DxlError):
    """Servos did not do what was asked of them. `failures` has one entry for each of these servos, by ID;
    the others did it."""

    def __init__(self, port: str, failures: Mapping[int, ServoFailure]) -> None:
        self.port = port
        self.failures = dict(failures)
        super().__init__(
            "\n".join(f"ID {servo_id} on {port} {one.text}" for servo_id, one in self.failures.items())
        )

    def __reduce__(self) -> tuple[type[ServoError], tuple[str, dict[int, ServoFailure]]]:
        return type(self), (self.port, self.failures)  # For pools of processes


_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|[0-9]+")
_SIDES = {"l": "left", "r": "right", "f": "front", "back": "rear", "hind": "rear", "top": "upper"}
_SIDES |= {side: side for side in ("left", "right", "front", "rear", "upper", "lower", "inner", "outer")}
"""Words in names that distinguish one limb from another, as numbers do, each with its standard form."""
_MOST_NEAR = 3
"""Number of equally similar names above which none is suggested; a longer list does not help."""


def near(name: str, known: Iterable[str]) -> tuple[str, ...]:
    """Return the known names that are probably meant by a misspelled one: at most two letters differ, or the
    words are the same.

    The words may be in another order, and one name may have an extra word next to at least two equal ones.
    A name of another side or with another number is never suggested, because it belongs to another limb."""
    wanted = _folded(name)
    most = 0 if len(wanted) < 3 else 1 if len(wanted) < 5 else 2
    found: dict[int, list[str]] = {}
    for each in dict.fromkeys(known):
        steps = 0 if _folded(each) == wanted else _edits(wanted, _folded(each), most)
        if steps > most and _alike(_words(name), _words(each)):
            steps = most
        if steps <= most and not _other_limb(_words(name), _words(each)):
            found.setdefault(steps, []).append(each)
    nearest = found[min(found)] if found else []
    return tuple(nearest) if len(nearest) <= _MOST_NEAR else ()


def _folded(name: str) -> str:
    return name.lower().replace("-", "_")


def _words(name: str) -> list[str]:
    return [word.lower() for word in _WORD.findall(name)]


def _alike(words: list[str], others: list[str]) -> bool:
    """Return True if two or more words agree, in any order, and at most one other word remains."""
    few, many = sorted((sorted(words), sorted(others)), key=len)
    left = list(many)
    for word in few:
        if word in left:
            left.remove(word)
    return len(few) >= 2 and len(left) == len(many) - len(few) <= 1


def _other_limb(words: list[str], others: list[str]) -> bool:
    """Return True if both names have words of a side, or both have numbers, and these differ."""
    sides = [sorted(_SIDES[word] for word in each if word in _SIDES) for each in (words, others)]
    numbers = [sorted("".join(filter(str.isdigit, each))) for each in (words, others)]
    return any(all(each) and each[0] != each[1] for each in (sides, numbers))


def _edits(one: str, other: str, most: int) -> int:
    """Return the edit distance of two words (insert, delete, replace, swap neighbors), or a number above
    `most`."""
    if abs(len(one) - len(other)) > most:
        return most + 1
    before: list[int] = []
    row = list(range(len(other) + 1))
    for i, letter in enumerate(one, 1):
        above, before, row = before, row, [i]
        for j, its in enumerate(other, 1):
            steps = min(before[j] + 1, row[-1] + 1, before[j - 1] + (letter != its))
            if i > 1 and j > 1 and (letter, one[i - 2]) == (other[j - 2], its):
                steps = min(steps, above[j - 2] + 1)
            row.append(steps)
    return row[-1]


def suggestion(name: str, known: Iterable[str], otherwise: str = "") -> str:
    """Return a hint for an unknown name: `did you mean ...?` with similar names, else `otherwise`, else
    the list of known names."""
    known = sorted(set(known))
    words = name.split()
    if len(words) > 1 and set(words) <= set(known):
        return f"write {', '.join(words)}"
    if meant := near(name, known):
        return f"did you mean {' or '.join(meant)}?"
    return otherwise or (f"known: {', '.join(known)}" if known else "there is none")


def counted(number: int, one: str, many: str) -> str:
    """Return a number with its noun, such as `1 period` or `2 periods`: `one` for exactly one, `many`
    otherwise, including zero."""
    return f"{number} {one if number == 1 else many}"


def help_link(heading: str) -> str:
    """Return `see ADDRESS#HEADING` for the end of a message: the address of the symptom on the page "It does
    not work".

    Args:
        heading: Anchor of a heading of docs/how-to/it-does-not-work.md, such as `no-servo-answers`.
    """
    return f"see {HELP}#{heading}"
