"""Robot file as text in which single values are replaced. All other bytes stay, comments included.

A library that parses and rewrites the file would keep comments, but not spaces, quotes and line breaks.
Therefore the nodes of the robot file's own parser locate each value, and only these characters are replaced.
"""

from __future__ import annotations

import codecs
import difflib
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

from dxlrun import InputError
from dxlrun.tooling.files import KeyPath, Mark, Problem
from dxlrun.tooling.output import unwritable
from dxlrun.tooling.robots import Source, read_sources


class _Edit(NamedTuple):
    """Replacement of a file's characters from `start` to before `end`; an empty range inserts the text."""

    start: int
    end: int
    text: str


class RobotText:
    """Text of a robot file and its included files; `plan_value` plans changes of values, and `write_files`
    writes them.

    A key path such as `("joints", "pan", "reference")` names a value.
    """

    def __init__(self, robot: Path) -> None:
        """Read the robot file and the files that it includes.

        Raises:
            InputError: A file cannot be read.
        """
        self._sources: Sequence[Source] = read_sources(robot)
        self._before = {source.path: source.path.read_bytes() for source in self._sources}
        self._edits: dict[Path, list[_Edit]] = {source.path: [] for source in self._sources}
        self._uses = [Counter(map(id, _nodes(source.tree.root))) for source in self._sources]

    def check_path(self, path: KeyPath) -> None:
        """Check that the value at a key path can be replaced or added.

        Raises:
            InputError: The value comes from an alias or an argument, a key above it is not a mapping, or its
                file is read-only.
        """
        source, at, node = self._own(path)
        if not os.access(source.path.resolve(), os.W_OK):
            raise InputError(f"{source.path} is read-only; make it writable")
        if self._uses[self._sources.index(source)][id(node)] > 1:
            what = f"{_words(path)} is shared by an alias"
            raise _refuse_node(source, node, what, "write the value at each place")
        if at == path and any("${" in str(one.value) for one in _nodes(node)):
            raise _refuse_node(
                source, node, f"{_words(path)} comes from an argument", "write the value itself"
            )
        if at != path and not isinstance(node, yaml.MappingNode):
            raise _refuse_node(source, node, f"{_words(at)} is not a mapping", "write it as a mapping")

    def plan_value(self, path: KeyPath, value: str | Sequence[str]) -> None:
        """Plan a new value, or new items of a list, for a key path; a missing key is added.

        Raises InputError as `check_path`.
        """
        self.check_path(path)
        source, at, node = self._own(path)
        edits = self._edits[source.path]
        if at != path and isinstance(node, yaml.MappingNode):
            edits.append(_inserted(source.text, node, path[len(at) :], _flow(value)))
        elif not isinstance(value, str) and isinstance(node, yaml.SequenceNode):
            edits += [_replaced(item, text) for item, text in zip(node.value, value, strict=True)]
        else:
            edits.append(_replaced(node, _flow(value)))

    def unit(self, path: KeyPath) -> str:
        """Return the unit in which the file gives a value, or a list's first item; empty without one."""
        _, at, node = self._own(path)
        scalars = [one for one in _nodes(node) if isinstance(one, yaml.ScalarNode)] if at == path else []
        found = re.search(r"[a-z]+$", scalars[0].value) if scalars else None
        return found[0] if found else ""

    def diff(self) -> list[str]:
        """Return the planned changes of all files as lines in the format of `diff -u`."""
        lines: list[str] = []
        for path in [path for path, edits in self._edits.items() if edits]:
            old, new = (data.decode().splitlines() for data in (self._before[path], self._after(path)))
            names = f"{path} (now)", f"{path} (new)"
            lines += difflib.unified_diff(old, new, *names, lineterm="", n=1)
        return lines

    def write_files(self) -> None:
        """Write the planned changes. Each file is replaced atomically.

        Raises:
            InputError: A file was changed after it was read, or cannot be written.
        """
        changed = {path.resolve(): path for path, edits in self._edits.items() if edits}
        for place, path in changed.items():
            if place.read_bytes() != self._before[path]:
                raise InputError(
                    f"{path} was changed by another program, and nothing was written; start again"
                )
        # Complete all new files before the first old one is replaced.
        besides = {place: place.with_name(f".{place.name}.{os.getpid()}") for place in changed}
        try:
            for place, beside in besides.items():
                beside.write_bytes(self._after(changed[place]))
                shutil.copymode(place, beside)
            for place, beside in besides.items():
                beside.replace(place)
        except OSError as error:
            raise unwritable(Path(error.filename), error) from error
        finally:
            for beside in besides.values():
                beside.unlink(missing_ok=True)

    def _after(self, path: Path) -> bytes:
        data = self._before[path]
        text, mark = data.decode("utf-8-sig"), codecs.BOM_UTF8 if data.startswith(codecs.BOM_UTF8) else b""
        # Edit from the end, so that earlier positions stay valid. Of two edits at one position, the later
        # comes first.
        for edit in sorted(self._edits[path], key=lambda one: one.start)[::-1]:
            text = text[: edit.start] + edit.text + text[edit.end :]
        return mark + text.encode()

    def _own(self, path: KeyPath) -> tuple[Source, KeyPath, yaml.Node]:
        """Return the file to change for a key path: the one with the longest existing prefix of the path. The
        prefix and the YAML node there are returned, too; if the value exists, it is the whole path."""
        found = ((source, *_nearest(source.tree.root, path)) for source in reversed(self._sources))
        # max returns the first of equal lengths: the file with the highest priority.
        return max(found, key=lambda one: len(one[1]))


def _refuse_node(source: Source, node: yaml.Node, what: str, fix: str) -> InputError:
    """Return the error for a value that cannot be replaced: its file, line and column, the problem, a fix."""
    place = node.start_mark
    return InputError([Problem(Mark(str(source.path), place.line + 1, place.column + 1), what, fix)])


def _nodes(node: yaml.Node) -> Iterator[yaml.Node]:
    """Yield a YAML node and all nodes below it. A node behind several aliases is yielded once per use."""
    yield node
    children = node.value if isinstance(node, yaml.SequenceNode) else ()
    if isinstance(node, yaml.MappingNode):
        children = [value for _, value in node.value]
    for child in children:
        yield from _nodes(child)


def _nearest(root: yaml.Node, path: KeyPath) -> tuple[KeyPath, yaml.Node]:
    """Return the longest prefix of a key path that exists below a YAML node, and the node there."""
    node = root
    for index, key in enumerate(path):
        pairs = node.value if isinstance(node, yaml.MappingNode) else ()
        found = next((value for name, value in pairs if name.value == key), None)
        if found is None:
            return path[:index], node
        node = found
    return path, node


def _replaced(node: yaml.Node, text: str) -> _Edit:
    return _Edit(node.start_mark.index, node.end_mark.index, text)


def _inserted(text: str, node: yaml.CollectionNode, keys: KeyPath, value: str) -> _Edit:
    """Return the edit that adds a value under nested keys to a mapping, after its other keys."""
    entry = f"{keys[0]}: " + "".join(f"{{{key}: " for key in keys[1:]) + value + "}" * (len(keys) - 1)
    # The value of an alias is before its key.
    here = [child for name, child in node.value if child.start_mark.index > name.start_mark.index]
    if node.flow_style:
        if here and here[-1] is node.value[-1][1]:
            return _Edit(here[-1].end_mark.index, here[-1].end_mark.index, f", {entry}")
        begin = node.start_mark.index + 1
        return _Edit(begin, begin, f"{entry}{', ' if node.value else ''}")
    newline = "\r\n" if "\r\n" in text else "\n"
    first = node.value[0][0].start_mark
    for child in reversed(here):
        plain = isinstance(child, yaml.ScalarNode) and child.style not in ("|", ">")
        if plain or (not isinstance(child, yaml.ScalarNode) and child.flow_style):
            line = text.find("\n", child.end_mark.index)
            end = len(text) if line < 0 else line - text[:line].endswith("\r")
            return _Edit(end, end, f"{newline}{' ' * first.column}{entry}")
    return _Edit(first.index, first.index, f"{entry}{newline}{' ' * first.column}")


def _flow(value: str | Sequence[str]) -> str:
    return value if isinstance(value, str) else f"[{', '.join(value)}]"


def _words(path: KeyPath) -> str:
    return ".".join(map(str, path))
