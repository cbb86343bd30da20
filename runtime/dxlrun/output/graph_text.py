"""Graph text: draws a graph with box characters for a terminal, or lists its edges if it is too wide."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from functools import reduce
from operator import or_

from dxlrun.output.graph import Graph, LayeredGraph, Node, placed

_UP, _DOWN, _LEFT, _RIGHT = 1, 2, 4, 8
_LINES = " ╵╷│╴┘┐┤╶└┌├─┴┬┼"
"""Line characters; the index is the sum of the directions _UP, _DOWN, _LEFT, _RIGHT of a line."""
_INACTIVE_LINES = str.maketrans("│─", "┊┄")
_CROSSED = "╫"
"""Character where lines of two nodes cross without touching; ┼ is a junction."""
_ASCII = str.maketrans("╵╷│╴┘┐┤╶└┌├─┴┬┼╫┊┄▶", "|||-+++-+++-+++|:.>")
_UPRIGHT, _LEVEL = _UP | _DOWN, _LEFT | _RIGHT
_EDGE = 2
"""Columns between the text of a box and its outside, with the border."""


def graph_text(graph: Graph, width: int, *, ascii_only: bool = False) -> str:
    """Draw a graph as text of at most `width` columns; if it does not fit, list its edges."""
    lines = _Drawing(placed(graph)).lines() if graph.nodes else []
    if any(len(line) > width for line in lines):
        lines = [short for line in _list(graph) for short in _wrapped(line, width)]
    text = "\n".join(line.rstrip() for line in lines)
    return text.translate(_ASCII) if ascii_only else text


def shown_lines(node: Node) -> tuple[str, ...]:
    """Return the lines of a node's box; an inactive controller is marked in the first one."""
    first, *more = node.lines
    return (first if node.active else f"{first} (inactive)", *more)


class _Drawing:
    """Draws a graph on a grid of characters.

    Boxes begin at even rows. Lines enter at odd rows and leave at even ones, so lines of different nodes
    never share a row. Each node has its own column for outgoing lines.
    """

    def __init__(self, graph: LayeredGraph) -> None:
        self._graph = graph
        self._lines: dict[tuple[int, int], dict[str, int]] = {}
        """For each (row, column), the directions of the lines there, by the node that each line leaves."""
        self._texts: dict[tuple[int, int], str] = {}
        self._dashed: set[tuple[int, int]] = set()
        self._row: dict[str, int] = {}
        for layer in graph.layers:
            row = 0
            for name in layer:
                self._row[name] = row
                row += self._height(name)
        left = 0
        for layer in graph.layers:
            width = max(self._width(name) for name in layer)
            for name in layer:
                self._place(name, left, width)
            left = self._join(layer, left + width)

    def lines(self) -> list[str]:
        """Return the drawing as lines of text."""
        cells = {at: _drawn(list(bits.values())) for at, bits in self._lines.items()}
        for at in self._dashed:
            cells[at] = cells[at].translate(_INACTIVE_LINES)
        cells |= self._texts
        height = 1 + max(row for row, _ in cells)
        width = 1 + max(column for _, column in cells)
        return ["".join(cells.get((row, column), " ") for column in range(width)) for row in range(height)]

    def _width(self, name: str) -> int:
        node = self._graph.nodes.get(name)
        return 1 if node is None else max(map(len, (*shown_lines(node), node.out))) + 2 * _EDGE

    def _height(self, name: str) -> int:
        """Return the rows that a node needs, with the free rows below it."""
        node = self._graph.nodes.get(name)
        return 4 if node is None else _even(len(shown_lines(node)) + bool(node.out)) + 2

    def _out_row(self, name: str) -> int:
        return self._row[name] + self._height(name) - 2

    def _place(self, name: str, left: int, width: int) -> None:
        """Draw the box of a node, or the line of an edge that crosses this layer."""
        node, row = self._graph.nodes.get(name), self._row[name]
        right, bottom = left + width - 1, self._out_row(name) + 1
        if node is None:
            self._line(name, (row + 1, left), (row + 1, right))
            self._line(name, (row + 1, right), (row + 2, right))
            return
        corners = (row, left), (row, right), (bottom, right), (bottom, left)
        for begin, end in zip(corners, (*corners[1:], corners[0]), strict=True):
            self._line(name, begin, end)
        if not node.active:
            frame = {(each, column) for each in (row, bottom) for column in range(left, right + 1)}
            self._dashed |= frame | {
                (each, column) for each in range(row, bottom) for column in (left, right)
            }
        for number, text in enumerate(shown_lines(node), row + 1):
            self._text(text, number, left + _EDGE)
        self._text(node.out, bottom - 1, right + 1 - _EDGE - len(node.out))

    def _join(self, layer: Sequence[str], left: int) -> int:
        """Draw all edges from a layer to the next one; return the column where the next layer begins."""
        ends = {name: [step.target for step in self._graph.steps if step.source == name] for name in layer}
        leading = [name for name in layer if ends[name]]
        right = left + 2 * len(leading) + 3
        for number, name in enumerate(leading):
            column, out = left + 1 + 2 * number, self._out_row(name)
            self._line(name, (out, left - 1), (out, column))
            for end in ends[name]:
                row = self._row[end] + 1
                self._line(name, (out, column), (row, column))
                is_node = end in self._graph.nodes
                self._line(name, (row, column), (row, right - is_node))
                if is_node:
                    self._texts[row, right - 1] = "▶"
        return right

    def _line(self, name: str, begin: tuple[int, int], end: tuple[int, int]) -> None:
        (row, column), (last_row, last_column) = sorted((begin, end))
        for each in range(row, last_row):
            self._add(name, (each, column), _DOWN)
            self._add(name, (each + 1, column), _UP)
        for each in range(min(column, last_column), max(column, last_column)):
            self._add(name, (last_row, each), _RIGHT)
            self._add(name, (last_row, each + 1), _LEFT)

    def _add(self, name: str, at: tuple[int, int], direction: int) -> None:
        bits = self._lines.setdefault(at, {})
        bits[name] = bits.get(name, 0) | direction

    def _text(self, text: str, row: int, column: int) -> None:
        for number, character in enumerate(text):
            self._texts[row, column + number] = character


def _drawn(directions: Sequence[int]) -> str:
    """Return the character for the lines that several nodes have at one place."""
    if _UPRIGHT in directions and set(directions) <= {_UPRIGHT, _LEVEL} and _LEVEL in directions:
        return _CROSSED
    return _LINES[reduce(or_, directions)]


def _even(number: int) -> int:
    return number + number % 2


def _wrapped(line: str, width: int) -> list[str]:
    """Wrap a line of the list of edges between words."""
    indent = " " * 6
    return textwrap.wrap(line, max(width, 20), subsequent_indent=indent, break_on_hyphens=False) or [line]


def _list(graph: Graph) -> Iterator[str]:
    """Yield the list of edges as lines: each node, and below it the nodes that its edges reach."""
    named = {node.name: node for node in graph.nodes}
    for node in graph.nodes:
        ends = [named[edge.target] for edge in graph.edges if edge.source == node.name]
        if ends or node.kind == "controller":
            yield " ".join(shown_lines(node))
        for end in ends:
            yield f"  {node.out} ─▶ {' '.join(end.lines)}"
