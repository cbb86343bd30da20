"""The text of a robot file in which values are replaced: every other byte stays, and so do its comments.

A library that reads a file and writes it anew keeps comments, but not the spaces, quotes and line breaks of
the rest; so the nodes that the robot file's own reader finds say where a value stands, and only that is cut
out.
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
    """Characters that are replaced; none: something is put in."""

    start: int
    end: int
    text: str


class RobotText:
    """A robot file with those that it includes; `put` plans what `write` does."""

    def __init__(self, robot: Path) -> None:
        """Raises InputError where one of them cannot be read."""
        self._sources: Sequence[Source] = read_sources(robot)
        self._before = {source.path: source.path.read_bytes() for source in self._sources}
        self._edits: dict[Path, list[_Edit]] = {source.path: [] for source in self._sources}
        self._uses = [Counter(map(id, _nodes(source.tree.root))) for source in self._sources]

    def check(self, path: KeyPath) -> None:
        """Raise InputError where a value could not be put at a path, or its file not be written."""
        source, at, node = self._own(path)
        if not os.access(source.path.resolve(), os.W_OK):
            raise InputError(f"{source.path} cannot be written: it is read-only; change that first")
        if self._uses[self._sources.index(source)][id(node)] > 1:
            what = f"{_words(path)} is shared by an alias"
            raise _refuse_node(source, node, what, "write it out for each")
        if at == path and any("${" in str(one.value) for one in _nodes(node)):
            raise _refuse_node(
                source, node, f"{_words(path)} is made of an argument", "write the value itself"
            )
        if at != path and not isinstance(node, yaml.MappingNode):
            raise _refuse_node(source, node, f"{_words(at)} is no mapping", "write its keys below it")

    def put(self, path: KeyPath, value: str | Sequence[str]) -> None:
        """Plan a value at a path, or the items of a list; raises InputError as `check`."""
        self.check(path)
        source, at, node = self._own(path)
        edits = self._edits[source.path]
        if at != path and isinstance(node, yaml.MappingNode):
            edits.append(_inserted(source.text, node, path[len(at) :], _flow(value)))
        elif not isinstance(value, str) and isinstance(node, yaml.SequenceNode):
            edits += [_replaced(item, text) for item, text in zip(node.value, value, strict=True)]
        else:
            edits.append(_replaced(node, _flow(value)))

    def unit(self, path: KeyPath) -> str:
        """Return the unit in which a value, or the first of a list, is written; empty: there is none."""
        _, at, node = self._own(path)
        scalars = [one for one in _nodes(node) if isinstance(one, yaml.ScalarNode)] if at == path else []
        found = re.search(r"[a-z]+$", scalars[0].value) if scalars else None
        return found[0] if found else ""

    def diff(self) -> list[str]:
        """Return the lines that change, as `diff -u` shows them."""
        lines: list[str] = []
        for path in [path for path, edits in self._edits.items() if edits]:
            old, new = (data.decode().splitlines() for data in (self._before[path], self._after(path)))
            names = f"{path} as it is", f"{path} as it will be"
            lines += difflib.unified_diff(old, new, *names, lineterm="", n=1)
        return lines

    def write(self) -> None:
        """Write what was planned; each file appears whole. Raises InputError where one was changed."""
        changed = {path.resolve(): path for path, edits in self._edits.items() if edits}
        for place, path in changed.items():
            if place.read_bytes() != self._before[path]:
                raise InputError(f"{path} was changed meanwhile, so nothing was written; begin again")
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
        # from the end, so that places stay; of two at one place the later is written first
        for edit in sorted(self._edits[path], key=lambda one: one.start)[::-1]:
            text = text[: edit.start] + edit.text + text[edit.end :]
        return mark + text.encode()

    def _own(self, path: KeyPath) -> tuple[Source, KeyPath, yaml.Node]:
        """Return the file that has a value, or else the most of the way to it, with the node there."""
        found = ((source, *_nearest(source.tree.root, path)) for source in reversed(self._sources))
        return max(found, key=lambda one: len(one[1]))  # the first of the longest: the strongest file


def _refuse_node(source: Source, node: yaml.Node, what: str, fix: str) -> InputError:
    """Return the error of a value that cannot be replaced, at its place."""
    place = node.start_mark
    return InputError([Problem(Mark(str(source.path), place.line + 1, place.column + 1), what, fix)])


def _nodes(node: yaml.Node) -> Iterator[yaml.Node]:
    """Yield a node and all below it, each as often as it is used."""
    yield node
    children = node.value if isinstance(node, yaml.SequenceNode) else ()
    if isinstance(node, yaml.MappingNode):
        children = [value for _, value in node.value]
    for child in children:
        yield from _nodes(child)


def _nearest(root: yaml.Node, path: KeyPath) -> tuple[KeyPath, yaml.Node]:
    """Return the way to a value as far as there is one, and the node at its end."""
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
    """Return the edit that gives a mapping another key, behind those that it has."""
    entry = f"{keys[0]}: " + "".join(f"{{{key}: " for key in keys[1:]) + value + "}" * (len(keys) - 1)
    here = [child for name, child in node.value if child.start_mark.index > name.start_mark.index]  # no alias
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
