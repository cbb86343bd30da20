"""Two runs compared: which figures differ by more than their noise, and what changed between the runs.

A figure differs when its blocks in one run are larger than those in the other by a Mann-Whitney U test (H. B.
Mann, D. R. Whitney, Ann. Math. Stat. 18, 1947; normal approximation, corrected for ties). Blocks that follow
each other are alike, so each run counts as n (1 - r) / (1 + r) blocks, r the autocorrelation of their ranks
at lag 1 (F. W. Zwiers, H. von Storch, J. Climate 8, 1995), corrected for its bias in short series. Many
figures are compared at once, so their probabilities get Holm's correction (S. Holm, Scand. J. Statist. 6,
1979). Times and tracking errors have to differ by 2 % too.

Temperatures and voltages change slowly, so their blocks are not alike within a run: they differ when the
ranges of their blocks are apart by more than 2 deg C or 0.2 V.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.log.reader import Log
from dxlrun.output.table import Column, Part, Sentence, Table, microseconds
from dxlrun_analysis.season.blocks import Blocks, Figure
from dxlrun_analysis.season.changes import Change, changes

LEVEL = 0.002
"""Corrected probability below which a figure differs. Measured on 1500 pairs of runs that are alike, of 60
figures each: a difference in 0.1 % of the pairs, in 1.0 % with r = 0.6 in all figures, 1.9 % with r = 0.9."""
_LEAST_BLOCKS = 8
_RELEVANT = 0.022
"""The width of the bins of times; less is of no use for tracking errors either."""
_APART = {"deg C": 2.0, "V": 0.2}
_MOST_SHOWN = 40
_MOST_CHANGES = 40

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Difference:
    """A figure that differs."""

    figure: str
    unit: str
    """us, rad, deg C, V; empty: a share from 0 to 1."""
    first: float
    second: float
    probability: float | None
    """Of such a difference by chance, corrected for the number of figures; None where ranges are compared."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """What changed from one run to another, and which figures differ by more than their noise."""

    changes: tuple[Change, ...]
    robot_file: tuple[str, ...]
    """Lines of the robot file that differ, as `diff -u` writes them; of many the first."""
    differences: tuple[Difference, ...]
    """The largest first, relative to its value."""
    compared: int
    """Figures that both runs have."""
    too_short: tuple[str, ...]
    """Figures that were not compared: a run has fewer than 8 blocks of them."""


def compare(first: tuple[Log, Blocks], second: tuple[Log, Blocks]) -> Comparison:
    """Compare two runs: each by what its log says about itself, and its figures."""
    changed, diff = changes(first[0], second[0])
    differences, compared, short = differing(first[1].figures(), second[1].figures())
    return Comparison(changed, diff, differences, compared, short)


def differing(
    first: Mapping[str, Figure], second: Mapping[str, Figure]
) -> tuple[tuple[Difference, ...], int, tuple[str, ...]]:
    """Return the figures that differ, how many were compared, and those that could not be."""
    chances: dict[str, float] = {}
    found: list[Difference] = []
    short: list[str] = []
    for name in first:
        if name not in second:
            continue
        one, other = first[name], second[name]
        if one.level:
            if _apart(one, other) > _APART[one.unit]:
                found.append(Difference(name, one.unit, one.overall, other.overall, None))
        elif min(len(one.blocks), len(other.blocks)) < _LEAST_BLOCKS:
            short.append(name)
        else:
            chances[name] = chance(one.blocks, other.blocks)
    levels = sum(first[name].level for name in first if name in second)
    for name, probability in holm(chances).items():
        one, other = first[name], second[name]
        if probability < LEVEL and (one.unit == "" or _share(one.overall, other.overall) > _RELEVANT):
            found.append(Difference(name, one.unit, one.overall, other.overall, probability))
    found.sort(key=lambda each: -_share(each.first, each.second))
    return tuple(found), len(chances) + levels, tuple(short)


def chance(first: Floats, second: Floats) -> float:
    """Return the probability of blocks as different as these in two runs that are alike."""
    together = np.concatenate((first, second))
    rank = _ranks(together)
    n, m = len(first), len(second)
    above = float(rank[:n].sum()) - n * (n + 1) / 2
    _, ties = np.unique(together, return_counts=True)
    tied = 1 - float(np.sum(ties.astype(float) ** 3 - ties)) / float((n + m) ** 3 - (n + m))
    if tied <= 0:
        return 1.0  # all are equal
    a, b = _effective(rank[:n]), _effective(rank[n:])
    deviation = math.sqrt((a + b + 1) / (12 * a * b) * tied)
    return math.erfc(max(0.0, abs(above / (n * m) - 0.5) - 0.5 / (n * m)) / deviation / math.sqrt(2))


def holm(chances: Mapping[str, float]) -> dict[str, float]:
    """Return probabilities that are corrected for their number."""
    corrected: dict[str, float] = {}
    worst = 0.0
    ordered = sorted(chances.items(), key=lambda item: item[1])
    for place, (name, probability) in enumerate(ordered):
        worst = max(worst, min(1.0, probability * (len(ordered) - place)))
        corrected[name] = worst
    return corrected


def _effective(ranks: Floats) -> float:
    """Return how many independent values a series of ranks is worth; at least two."""
    count = len(ranks)
    centred = ranks - ranks.mean()
    power = float(centred @ centred)
    if power == 0:
        return float(count)
    r = float(centred[1:] @ centred[:-1]) / power
    r = min(0.95, max(0.0, r + (1 + 4 * max(r, 0.0)) / count))  # its bias: Kendall, Biometrika 41, 1954
    return max(2.0, count * (1 - r) / (1 + r))


def _ranks(values: Floats) -> Floats:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    found: Floats = (ends - (counts - 1) / 2)[inverse]
    return found


def _apart(first: Figure, second: Figure) -> float:
    """Return the distance between the ranges of two figures' blocks; below 0 they overlap."""
    if not (len(first.blocks) and len(second.blocks)):
        return 0.0
    gaps = first.blocks.min() - second.blocks.max(), second.blocks.min() - first.blocks.max()
    return float(max(gaps))


def _share(first: float, second: float) -> float:
    """Return a difference as a share of the greater value."""
    greater = max(abs(first), abs(second))
    return abs(first - second) / greater if greater else 0.0


# For the terminal


def parts(found: Comparison) -> Sequence[Part]:
    """Return what a terminal shows: what changed, and what differs."""
    shown: list[Part] = []
    rows = [(change.what, change.key, _cut(change.first), _cut(change.second)) for change in found.changes]
    more = len(rows) - _MOST_CHANGES
    names = [Column("changed", "name"), Column("", "text"), Column("A", "text"), Column("B", "text")]
    if rows:
        shown.append(Table.of("", names, rows[:_MOST_CHANGES]))
        shown += [f"and {more} more, in --json"] if more > 0 else []
    else:
        shown.append("Nothing changed: robot file, plan, code and machine are the same.")
    if found.robot_file:
        shown += ["", "robot file:", *(f"  {line}" for line in found.robot_file)]
    shown += ["", *_differing(found)]
    return shown


def _differing(found: Comparison) -> Sequence[Part]:
    shown: list[Part] = []
    columns = [
        Column("differs", "name"),
        Column("A"),
        Column("B"),
        Column("change", missing="-"),
        Column("p"),
    ]
    rows = [
        (
            one.figure,
            _value(one, one.first),
            _value(one, one.second),
            f"{one.second / one.first - 1:+.0%}" if one.first > 0 and one.unit != "deg C" else None,
            "" if one.probability is None else f"{one.probability:.1g}",
        )
        for one in found.differences
    ]
    if rows:
        shown.append(Table.of("", columns, rows[:_MOST_SHOWN]))
    alike = found.compared - len(rows)
    if found.compared:
        text = f"{len(rows)} of {found.compared} figures differ by more than their noise within the runs."
        shown += [*([""] if rows else []), Sentence(text, "plain" if alike else "warning")]
    if found.too_short:
        shown.append(f"{len(found.too_short)} figures were not compared: a run is too short for its noise.")
    return shown


def _value(one: Difference, value: float) -> str:
    if one.unit == "us":
        return f"{value:.1f} us" if value < 100 else microseconds(value)
    if one.unit == "":
        return f"{value:.3%}"
    return f"{value:.4f} {one.unit}" if one.unit in ("rad", "m") else f"{value:.1f} {one.unit}"


def _cut(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."
