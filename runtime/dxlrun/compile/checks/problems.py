"""Collecting what is wrong, so that a person mends a file once and not ten times."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

from dxlrun.errors import InputError, Mark, Problem


class Problems:
    """All problems of one compilation; checks add to it and go on."""

    __slots__ = ("_found",)

    def __init__(self) -> None:
        self._found: list[Problem] = []

    def error(self, mark: Mark, what: str, mend: str) -> None:
        """Add something that forbids the run."""
        self._found.append(Problem(mark, what, mend))

    def warning(self, mark: Mark, what: str, mend: str) -> None:
        """Add something that a person should look at, but that runs."""
        self._found.append(Problem(mark, what, mend, severity="warning"))

    def extend(self, problems: Iterable[Problem]) -> None:
        """Add what another check has found."""
        self._found.extend(problems)

    @property
    def errors(self) -> tuple[Problem, ...]:
        """The errors in file order."""
        return tuple(sorted((p for p in self._found if p.severity == "error"), key=lambda p: p.mark))

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """The warnings in file order."""
        return tuple(sorted((p for p in self._found if p.severity == "warning"), key=lambda p: p.mark))

    def refuse(self) -> None:
        """Raise InputError with the errors, and after them the warnings, if there is any error."""
        if self.errors:
            raise InputError(self.errors + self.warnings)


def suggestion(name: str, known: Sequence[str]) -> str:
    """Return how to mend an unknown name: the closest known one, or all of them."""
    if not known:
        return "there is none"
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if close:
        return f"did you mean {close[0]}?"
    return f"known: {', '.join(sorted(known))}"
