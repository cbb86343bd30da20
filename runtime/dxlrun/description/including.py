"""Including: merges a robot file and the files (fragments) in its `include` into one document.

`include: [fragments/head.yaml]` is relative to the file that contains it. Mappings are merged key by key at
every depth. The including file takes precedence over its fragments, and a later fragment over an earlier one.
Marks refer to the file in which a value is written. A fragment that is reached twice counts once, where it is
reached first.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import msgspec

from dxlrun.description.document import (
    LARGEST_FILE,
    Fill,
    KeyPath,
    Marks,
    PlainDocument,
    Tree,
    grow,
    literal,
    parse,
    read_text,
)
from dxlrun.description.form_problems import format_value
from dxlrun.errors import InputError, Mark, Problem

KEY = "include"
MOST_LEVELS = 8  # longest chain of includes
MOST_FILES = 64  # files of one robot


class Source(msgspec.Struct, frozen=True):
    """One file of a robot (the robot file or an included one): its text and its parsed YAML."""

    path: Path
    text: str
    tree: Tree
    declared: PlainDocument  # values before arguments are inserted

    def grown(self, fill: Fill) -> PlainDocument:
        """Return the values of the file after `fill` has inserted the arguments."""
        return grow(self.tree, str(self.path), fill)


def read_sources(path: Path) -> tuple[Source, ...]:
    """Read a robot file and all files that it includes: lowest precedence first, the robot file last.

    Raises:
        InputError: A file is not YAML, or includes cannot be followed; all such problems at once.
    """
    text = read_text(path)
    collector = _Collector()
    collector.add_file(path, text, parse(text, str(path)), ())
    if collector.problems:
        raise InputError(collector.problems)
    return tuple(collector.sources)


class _Collector:
    """Reads included files recursively, each once, and collects the problems."""

    def __init__(self) -> None:
        self.sources: list[Source] = []
        self.problems: list[Problem] = []
        self._done: set[Path] = set()
        self._characters = 0

    def add_file(self, path: Path, text: str, tree: Tree, above: tuple[Path, ...]) -> None:
        """Add all files that a file includes, then the file itself; `above` are the files that include it."""
        declared = grow(tree, str(path), literal)
        # Mark the file before its fragments, so that a second path to it does not read it again.
        self._done.add(path.resolve())
        self._characters += len(text)
        for entry, mark in self._entries(declared):
            self._follow(path, entry, mark, (*above, path.resolve()))
        self.sources.append(Source(path, text, tree, declared))

    def _entries(self, declared: PlainDocument) -> list[tuple[str, Mark]]:
        """Return the file names under `include` with their places; add a problem for anything else."""
        if KEY not in declared.data:
            return []
        entries, marks = declared.data[KEY], declared.marks
        if not isinstance(entries, list):
            self._refuse(
                marks.value(KEY),
                f"include is {format_value(entries)}, but must be a list",
                "write [fragment.yaml]",
            )
            return []
        found: list[tuple[str, Mark]] = []
        for index, entry in enumerate(entries):
            mark = marks.value(KEY, index)
            if not isinstance(entry, str) or not entry:
                self._refuse(
                    mark,
                    f"include[{index}] is {format_value(entry)}, but must be a file name",
                    "write a file name",
                )
            elif "${" in entry:
                self._refuse(mark, "include cannot contain ${...}", "write the file name")
            else:
                found.append((entry, mark))
        return found

    def _follow(self, path: Path, entry: str, mark: Mark, above: tuple[Path, ...]) -> None:
        fragment = path.parent / entry
        place = fragment.resolve()
        if place in above:
            chain = " -> ".join(each.name for each in (*above[above.index(place) :], place))
            self._refuse(mark, f"{entry} includes itself ({chain})", "remove one of these includes")
        elif place in self._done:
            return
        elif len(above) >= MOST_LEVELS:
            self._refuse(
                mark,
                f"includes are nested deeper than {MOST_LEVELS} files",
                f"include {entry} in the robot file",
            )
        elif len(self._done) >= MOST_FILES:
            self._refuse(mark, f"more than {MOST_FILES} files are included", "merge some of them")
        elif not fragment.exists():
            fix = "check the name; it is relative to the folder of this file"
            self._refuse(mark, f"file {entry} not found", fix)
        else:
            self._read_fragment(fragment, entry, mark, above)

    def _read_fragment(self, fragment: Path, entry: str, mark: Mark, above: tuple[Path, ...]) -> None:
        try:
            text = read_text(fragment)
        except InputError as error:
            for problem in error.problems:
                at_file = problem.mark == Mark(str(fragment))  # the file itself, not a place in it
                what = f"{entry}: {problem.what}" if at_file else problem.what
                self._refuse(mark if at_file else problem.mark, what, problem.fix)
            return
        if self._characters + len(text) > LARGEST_FILE:
            what = f"with {entry} the robot file is larger than {LARGEST_FILE // 1024} KiB"
            self._refuse(mark, what, "shorten one of its files")
            return
        try:
            self.add_file(fragment, text, parse(text, str(fragment)), above)
        except InputError as error:
            self.problems.extend(error.problems)

    def _refuse(self, mark: Mark, what: str, fix: str) -> None:
        self.problems.append(Problem(mark, what, fix))


def merged(documents: Iterable[PlainDocument]) -> PlainDocument:
    """Merge documents into one, lowest precedence first; the problems of all are kept."""
    first, *others = documents
    for document in others:
        first = _over(first, document)
    return first


def _over(low: PlainDocument, high: PlainDocument) -> PlainDocument:
    """Merge two documents: mappings key by key, for anything else the value of `high` counts."""
    replaced: set[KeyPath] = set()
    data = _laid(low.data, high.data, (), replaced)

    def stays(path: KeyPath) -> bool:
        return not any(path[:end] in replaced for end in range(1, len(path) + 1))

    marks = Marks(
        high.marks.file,
        {**{path: mark for path, mark in low.marks.values.items() if stays(path)}, **high.marks.values},
        {**{path: mark for path, mark in low.marks.keys.items() if stays(path)}, **high.marks.keys},
        {**{path: text for path, text in low.marks.origins.items() if stays(path)}, **high.marks.origins},
    )
    unknown = high.unknown | {path for path in low.unknown if stays(path)}
    return PlainDocument(data, marks, (*low.problems, *high.problems), unknown)


def _laid(
    low: dict[str, object], high: dict[str, object], path: KeyPath, replaced: set[KeyPath]
) -> dict[str, object]:
    result = dict(low)
    for key, value in high.items():
        here = (*path, key)
        below = low.get(key)
        if isinstance(below, dict) and isinstance(value, dict):
            result[key] = _laid(below, value, here, replaced)
        else:
            if key in low:
                replaced.add(here)
            result[key] = value
    return result
