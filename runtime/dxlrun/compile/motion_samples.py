"""Samples: the targets of one part of a motion over time, listed in the file or computed from formulas.

simpleeval evaluates the formulas, within narrow bounds.
"""

from __future__ import annotations

import ast
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import msgspec
from simpleeval import (  # type: ignore[import-untyped]  # no type information is published
    InvalidExpression,
    SimpleEval,
)

from dxlrun.compile.problems import Problems
from dxlrun.description.motion import Formula, FormulaPart, MotionDescription, PointsPart
from dxlrun.description.units import plain
from dxlrun.errors import Mark

Quantity = Literal["position", "velocity", "acceleration"]
QUANTITIES: tuple[Quantity, ...] = ("position", "velocity", "acceleration")
LONGEST_FORMULA = 1000  # characters; bounds parsing and evaluation, together with the list of operations
DEEPEST_FORMULA = 100
"""Deepest nesting of operations in a formula; a sum of n terms has n. Keeps the evaluator below Python's
recursion limit."""

FUNCTIONS: Mapping[str, Callable[..., float]] = {
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "asin": math.asin,
    "acos": math.acos,
    "atan": math.atan,
    "atan2": math.atan2,
    "sinh": math.sinh,
    "cosh": math.cosh,
    "tanh": math.tanh,
    "sqrt": math.sqrt,
    "exp": math.exp,
    "log": math.log,
    "abs": abs,
    "min": min,
    "max": max,
}

_IN_SI = {"deg": " * pi / 180", "rad": "", "mm": " / 1000", "cm": " / 100", "m": "", "ms": " / 1000", "s": ""}
_QUANTITY = re.compile(rf"([\d.]+) *({'|'.join(_IN_SI)})\b")
"""A number with a unit, which other values of a motion have but formulas have not."""

_NODES = (ast.BinOp, ast.UnaryOp, ast.Constant, ast.Name, ast.Load, ast.Call)


def _power(base: float, exponent: float) -> float:
    # Floats overflow at once; integers would grow for minutes: 9**9**9.
    return math.pow(base, exponent)


_OPERATORS: Mapping[type[ast.AST], Callable[..., float]] = {
    ast.Add: lambda a, b: float(a) + float(b),
    ast.Sub: lambda a, b: float(a) - float(b),
    ast.Mult: lambda a, b: float(a) * float(b),
    ast.Div: lambda a, b: float(a) / float(b),
    ast.Mod: lambda a, b: float(a) % float(b),
    ast.Pow: _power,
    ast.USub: lambda a: -float(a),
    ast.UAdd: lambda a: +float(a),
}


class SampledTarget(msgspec.Struct, frozen=True):
    """Targets of one joint at one time: position, velocity and acceleration in rad or m; None: not given."""

    position: float | None
    velocity: float | None
    acceleration: float | None
    mark: Mark

    def value_of(self, quantity: Quantity) -> float | None:
        """Return the target of one quantity; None: not given."""
        value: float | None = getattr(self, quantity)
        return value


class MotionSample(msgspec.Struct, frozen=True):
    """Targets of all joints at one time of a motion, with their place in the file."""

    t_ns: int  # since the part's start
    targets: dict[str, SampledTarget]
    mark: Mark


def listed_samples(
    motion: MotionDescription, index: int, part: PointsPart, problems: Problems
) -> tuple[MotionSample, ...]:
    """Return the points of a part as samples; add an error if their times do not increase."""
    samples: list[MotionSample] = []
    for number, point in enumerate(part.points):
        path = ("motions", index, "points", number)
        if samples and point.time <= samples[-1].t_ns:
            problems.error(
                motion.marks.value(*path, "time"),
                f"time {point.time / 1e9:g} s is not after the time of the previous point, "
                f"{samples[-1].t_ns / 1e9:g} s",
                "sort the points by time",
            )
            continue
        targets = {
            joint: SampledTarget(
                plain(target.position),
                plain(target.velocity),
                plain(target.acceleration),
                motion.marks.key(*path, "joints", joint),
            )
            for joint, target in point.joints.items()
        }
        samples.append(MotionSample(point.time, targets, motion.marks.value(*path)))
    return tuple(samples)


def formula_texts(part: FormulaPart) -> tuple[str, ...]:
    """Return the texts of all formulas of a part."""
    texts = (_text(formula, quantity) for formula in part.joints.values() for quantity in QUANTITIES)
    return tuple(text for text in texts if text is not None)


def formula_samples(
    motion: MotionDescription, index: int, part: FormulaPart, problems: Problems
) -> tuple[MotionSample, ...]:
    """Evaluate the formulas of a part at `samples` equal steps over `duration`; empty if one is invalid."""
    count = part.samples
    times = [round(part.duration * i / max(1, count - 1)) for i in range(count)]
    columns: dict[str, dict[Quantity, list[float]]] = {}
    good = True
    for joint, formula in part.joints.items():
        columns[joint] = {}
        for quantity in QUANTITIES:
            text = _text(formula, quantity)
            if text is None:
                continue
            mark = motion.marks.value("motions", index, "joints", joint, quantity)
            values = _values(mark, text, times, problems)
            good = good and values is not None
            columns[joint][quantity] = values or []
    if not good:
        return ()
    marks = {joint: motion.marks.value("motions", index, "joints", joint, "position") for joint in columns}
    part_mark = motion.marks.value("motions", index)
    return tuple(
        MotionSample(
            t_ns, {joint: _target(columns[joint], row, marks[joint]) for joint in columns}, part_mark
        )
        for row, t_ns in enumerate(times)
    )


def _target(column: Mapping[Quantity, Sequence[float]], row: int, mark: Mark) -> SampledTarget:
    values = {quantity: column[quantity][row] for quantity in column}
    return SampledTarget(values.get("position"), values.get("velocity"), values.get("acceleration"), mark)


def _text(formula: Formula, quantity: Quantity) -> str | None:
    text: str | None = getattr(formula, quantity)
    return text


def _values(mark: Mark, text: str, times: Sequence[int], problems: Problems) -> list[float] | None:
    """Evaluate a formula at times in ns; None if it is invalid, with an error added."""
    try:
        formula = Expression(text)
    except ValueError as error:
        problems.error(mark, f"formula {text!r} cannot be read: {error}", "correct the formula")
        return None
    values: list[float] = []
    for t_ns in times:
        try:
            values.append(formula.at(t_ns * 1e-9))
        except ValueError as error:
            problems.error(
                mark,
                f"formula {text!r} has no value at t = {t_ns * 1e-9:.6g} s: {error}",
                "correct the formula",
            )
            return None
    return values


class Expression:
    """A formula of the time `t` in s, such as `0.5 * sin(2 * pi * t)`, parsed and checked.

    Raises:
        ValueError: The text is not a valid expression; one sentence.
    """

    __slots__ = ("_evaluator", "_tree", "text")

    def __init__(self, text: str) -> None:
        self.text = text
        self._tree = _parse(text)
        self._evaluator = SimpleEval(operators=dict(_OPERATORS), functions=dict(FUNCTIONS), names={})

    def at(self, t: float) -> float:
        """Return the formula's value at `t` s; raise ValueError if it is undefined or not finite."""
        self._evaluator.names = {"t": t, "pi": math.pi}
        try:
            value = float(self._evaluator.eval(self.text, previously_parsed=self._tree))
        except ZeroDivisionError:
            raise ValueError("division by zero") from None
        except OverflowError:
            raise ValueError("the value is too large") from None
        except InvalidExpression as error:
            raise ValueError(str(error)) from None
        except TypeError as error:
            raise ValueError(f"a function has the wrong number of arguments ({error})") from None
        except ValueError:
            raise ValueError(
                "a function is undefined (such as the root or logarithm of a negative number)"
            ) from None
        if not math.isfinite(value):
            raise ValueError("the value is not finite")
        return value


def _parse(text: str) -> ast.expr:
    if len(text) > LONGEST_FORMULA:
        raise ValueError(f"it has {len(text)} characters, at most {LONGEST_FORMULA} are allowed")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python warns of "2(t)", which is refused below
            tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        if quantity := _QUANTITY.search(text):
            raise ValueError(
                f"a formula has no units; write {quantity[1]}{_IN_SI[quantity[2]]} for {quantity[0]}"
            ) from None
        raise ValueError("it is not an expression, or a bracket or sign is missing") from None
    if _depth(tree) > DEEPEST_FORMULA:
        raise ValueError(f"more than {DEEPEST_FORMULA} operations are nested; group long sums")
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    for node in ast.walk(tree):
        if id(node) not in called or not isinstance(node, ast.Name):
            _check(node)
    return tree


def _depth(tree: ast.AST) -> int:
    level, depth = [tree], 0
    while level:
        level, depth = [child for node in level for child in ast.iter_child_nodes(node)], depth + 1
    return depth


def _check(node: ast.AST) -> None:
    if isinstance(node, ast.operator | ast.unaryop):
        if type(node) not in _OPERATORS:
            raise ValueError(f"it uses an unsupported operation ({type(node).__name__})")
    elif not isinstance(node, _NODES):
        raise ValueError(f"it uses an unsupported expression ({type(node).__name__})")
    elif isinstance(node, ast.Constant):
        if isinstance(node.value, bool) or not isinstance(node.value, int | float):
            raise ValueError(f"{node.value!r} is not a real number")
    elif isinstance(node, ast.Call):
        if not isinstance(node.func, ast.Name):
            raise ValueError("an operator is missing before a bracket; write 2 * (t), not 2(t)")
        if node.func.id not in FUNCTIONS:
            raise ValueError(f"unknown function {node.func.id}; known: {', '.join(sorted(FUNCTIONS))}")
        if node.keywords:
            raise ValueError("functions take no named arguments")
    elif isinstance(node, ast.Name) and node.id not in ("t", "pi"):
        raise ValueError(f"unknown name {node.id}; known: t (seconds) and pi")
