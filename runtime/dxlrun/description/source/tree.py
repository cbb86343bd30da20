"""Tree: YAML nodes -> plain Python values and the mark of each; arguments are put in on the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import yaml

from dxlrun.description.source.marks import KeyPath, Marks
from dxlrun.description.source.scalars import plain_value
from dxlrun.description.source.syntax import DEEPEST, MOST_NODES, Tree, node_mark, refusal
from dxlrun.errors import Mark, Problem


@dataclass(frozen=True, slots=True)
class Filled:
    """A scalar after arguments were put into it."""

    value: object
    origin: str | None = None
    """`rate:=100` when an argument is in it."""
    problems: tuple[tuple[str, str], ...] = ()
    """What is wrong, and how to fix it."""
    unknown: bool = False
    """The value could not be made; whoever checks it shall not complain again."""


Fill = Callable[[KeyPath, str, bool], Filled]
"""Path, text and whether it was quoted -> the value."""


def literal(path: KeyPath, text: str, quoted: bool) -> Filled:
    """Return what a scalar means as it stands."""
    return Filled(text if quoted else plain_value(text))


@dataclass(frozen=True, slots=True)
class Grown:
    """A document as plain values, with marks, and what was wrong on the way."""

    data: dict[str, object]
    marks: Marks
    problems: tuple[Problem, ...]
    unknown: frozenset[KeyPath]
    """Where a problem was already reported, so that the value there says nothing."""


def grow(tree: Tree, file: str, fill: Fill) -> Grown:
    """Return the values of a tree; raises InputError when its anchors make it endless or huge."""
    grower = _Grower(tree, file, fill)
    return Grown(
        grower.mapping(tree.root, ()),
        Marks(file, grower.values, grower.keys, grower.origins),
        (*tree.problems, *grower.problems),
        frozenset(grower.unknown),
    )


class _Grower:
    """Walks a tree once; depth is bounded by DEEPEST, so it may recurse."""

    def __init__(self, tree: Tree, file: str, fill: Fill) -> None:
        self._file = file
        self._fill = fill
        self._tagged = {problem.mark for problem in tree.problems}
        self._nodes = 0
        self.values: dict[KeyPath, Mark] = {}
        self.keys: dict[KeyPath, Mark] = {}
        self.origins: dict[KeyPath, str] = {}
        self.problems: list[Problem] = []
        self.unknown: set[KeyPath] = set()

    def value(self, node: yaml.Node, path: KeyPath) -> object:
        """Return what a node means."""
        if isinstance(node, yaml.MappingNode):
            return self.mapping(node, path)
        self._enter(node, path)
        if isinstance(node, yaml.SequenceNode):
            return [self.value(item, (*path, index)) for index, item in enumerate(node.value)]
        assert isinstance(node, yaml.ScalarNode)  # noqa: S101 (YAML has three kinds of nodes)
        return self._scalar(node, path)

    def mapping(self, node: yaml.MappingNode, path: KeyPath) -> dict[str, object]:
        """Return a mapping; keys are text as written, the first of two equal ones counts."""
        self._enter(node, path)
        result: dict[str, object] = {}
        for key_node, value_node in node.value:
            key = self._key(key_node)
            if key is None:
                continue
            here = (*path, key)
            mark = node_mark(key_node, self._file)
            if key in result:
                what = f"{'.'.join(map(str, here))} was already given in line {self.keys[here].line}"
                self.problems.append(Problem(mark, what, "keep one of the two"))
                continue
            self.keys[here] = mark
            result[key] = self.value(value_node, here)
        return result

    def _enter(self, node: yaml.Node, path: KeyPath) -> None:
        mark = node_mark(node, self._file)
        self._nodes += 1
        if len(path) > DEEPEST:
            what = f"this is nested deeper than {DEEPEST} levels, or an anchor contains itself"
            raise refusal(mark, what, "make it flatter")
        if self._nodes > MOST_NODES:
            what = f"the file has more than {MOST_NODES} values when its anchors are put in"
            raise refusal(mark, what, "write fewer")
        self.values[path] = mark
        if mark in self._tagged:
            self.unknown.add(path)

    def _key(self, node: yaml.Node) -> str | None:
        mark = node_mark(node, self._file)
        if not isinstance(node, yaml.ScalarNode):
            self.problems.append(
                Problem(mark, "a mapping or a list cannot be a key", "write a word before the ':'")
            )
            return None
        if node.value == "<<" and not _quoted(node):
            self.problems.append(Problem(mark, "the merge key << is not YAML 1.2", "write the keys out"))
            return None
        if not node.value:
            self.problems.append(Problem(mark, "a key is empty", "write a word before the ':'"))
            return None
        if "${" in node.value:
            self.problems.append(Problem(mark, "arguments are not put into keys", "write the key out"))
            return None
        return str(node.value)

    def _scalar(self, node: yaml.ScalarNode, path: KeyPath) -> object:
        filled = self._fill(path, node.value, _quoted(node))
        mark = self.values[path]
        self.problems.extend(Problem(mark, what, fix) for what, fix in filled.problems)
        if filled.unknown:
            self.unknown.add(path)
        if filled.origin is not None:
            self.origins[path] = filled.origin
        return filled.value


def _quoted(node: yaml.ScalarNode) -> bool:
    # the two scanners of PyYAML say "plain" in two ways: None and ""
    return bool(node.style)
