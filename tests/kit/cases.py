"""Cases as text: the form that the texts of the tests share, its parser, and how runners read a line.

    name: pair                         the head, in the language of the runner: often a robot file
    joints: {elbow: {bus: main, id: 3}}
    ====
    # 1.2 rad are 68.8 deg
    A lost servo is reported           the name of a case, at the margin
      at 1 silence servo=3             what happens
      => event servo_lost elbow        what is expected

A text without a line `====` has no head. Lines that start with `#` are comments. A case ends at a blank line,
and where a line at the margin follows an indented one; other lines at the margin belong to the case, as a
second change of a robot file does. The runner of a text describes its words. It refuses a wrong line with the
place of that line, FILE:LINE.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

RULE = "====\n"


class Line(NamedTuple):
    """A line without its indentation. A blank line has an empty text."""

    place: str  # FILE:LINE
    text: str
    is_indented: bool = False


class TextCase(NamedTuple):
    """A case with the head of its file. Its name is empty if its first line is indented."""

    file: Path
    head: str
    name: str
    place: str  # FILE:LINE of the first line
    lines: list[Line]


def read_head(file: Path) -> str:
    """Return the text before the line `====`."""
    return file.read_text("utf-8").rpartition(RULE)[0]


def read_lines(file: Path) -> Iterator[Line]:
    """Yield the lines after the head, without comments."""
    text = file.read_text("utf-8")
    first = text.rindex(RULE) + len(RULE) if RULE in text else 0
    for number, line in enumerate(text[first:].splitlines(), text[:first].count("\n") + 1):
        if not line.lstrip().startswith("#"):
            is_indented = line.startswith("  ")
            yield Line(f"{file.name}:{number}", line.lstrip() if is_indented else line, is_indented)


def read_cases(*paths: Path) -> Iterator[TextCase]:
    """Yield the cases of files, and of all texts of folders."""
    for path in paths:
        for file in sorted(path.glob("*.txt")) if path.is_dir() else [path]:
            yield from _cases_of(file)


def _cases_of(file: Path) -> list[TextCase]:
    cases: list[TextCase] = []
    head, before = read_head(file), Line("", "")
    for line in read_lines(file):
        begins = not before.text or (before.is_indented and not line.is_indented)
        if line.text and begins:
            cases.append(TextCase(file, head, "" if line.is_indented else line.text, line.place, []))
        if line.text and (line.is_indented or not begins):
            cases[-1].lines.append(line)
        before = line
    return cases


def case_parameters(*paths: Path) -> list[Any]:
    """Return cases as parameters of a test, with ids such as `goals.txt:12: A goal is reached`."""
    return [pytest.param(case, id=f"{case.place}: {case.name}") for case in read_cases(*paths)]


def find_form(forms: Mapping[str, Callable[..., Any]], text: str) -> Callable[..., Any] | None:
    """Return the function of the form that a text has, which gets the groups of its pattern last."""
    for pattern, act in forms.items():
        if found := re.fullmatch(pattern, text):
            groups = found.groups()
            return lambda *first: act(*first, *groups)
    return None


def read_form(forms: Mapping[str, Callable[..., Any]], text: str) -> Callable[..., Any]:
    """Return what `find_form` finds. Raises AssertionError where a text has none of the forms."""
    found = find_form(forms, text)
    assert found, f"{text!r} has none of the forms {[*forms]}"
    return found


def fits(found: str, text: str, *, whole: bool = True) -> bool:
    """Compare a text with one in which `...` stands for anything, or search for that one."""
    pattern = ".*".join(map(re.escape, text.split("...")))
    return (re.fullmatch if whole else re.search)(pattern, found, re.DOTALL) is not None


@contextmanager
def place_of(line: Line) -> Iterator[None]:
    """Add the place of a line to an error."""
    try:
        yield
    except Exception as error:
        error.add_note(f"{line.place}: {line.text}")
        raise
