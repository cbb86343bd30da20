"""Ranking: the runs of a sweep in order of a score, and how much each parameter decides about it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dxlrun.errors import counted
from dxlrun.output.table import Column, Part, Sentence, Table
from dxlrun_lab.sweep.measuring import Status
from dxlrun_lab.sweep.ranges import Value
from dxlrun_lab.sweep.results import ParameterColumn, Row
from dxlrun_lab.sweep.scores import Scores

By = Literal["rms", "worst", "overshoot", "settling", "energy", "temperature"]
_FIELDS: Mapping[By, tuple[str, str]] = {
    "rms": ("rms_rad", "rad"),
    "worst": ("worst_rad", "rad"),
    "overshoot": ("overshoot_rad", "rad"),
    "settling": ("settling_s", "s"),
    "energy": ("energy_j", "J"),
    "temperature": ("temperature_c", "degC"),
}
_SHOWN = 10


@dataclass(frozen=True, slots=True)
class Influence:
    """One parameter: the mean score at each of its values, over those of all others."""

    parameter: str
    best: Value
    best_mean: float
    worst: Value
    worst_mean: float
    share: float
    """Of the score's variance, that of these means: 1 where nothing else decides. First-order Sobol' index on
    a grid (Saltelli et al., Global Sensitivity Analysis, 2008, section 4.5)."""


def score(row: Row, by: By) -> float | None:
    """Return a run's score; None where it has none."""
    scores = row.measured.scores
    value = getattr(scores, _FIELDS[by][0]) if scores is not None else None
    return None if value is None else float(value)


def unit(by: By) -> str:
    """Return the unit of a score."""
    return _FIELDS[by][1]


def ranked(rows: Sequence[Row], by: By) -> list[Row]:
    """Return the rows that have a score, the best (lowest) first; equal ones as they were."""
    scored = [(found, row) for row in rows if (found := score(row, by)) is not None]
    return [row for _, row in sorted(scored, key=lambda one: one[0])]


def influences(columns: Sequence[ParameterColumn], rows: Sequence[Row], by: By) -> tuple[Influence, ...]:
    """Return the influence of each parameter, the greatest first; none where no score differs."""
    scored = [(row, found) for row in rows if (found := score(row, by)) is not None]
    values = np.array([found for _, found in scored])
    if not len(values) or not values.var() > 0:
        return ()
    effects: list[Influence] = []
    for index, column in enumerate(columns):
        groups: dict[Value, list[float]] = {}
        for row, value in scored:
            groups.setdefault(row.values[index], []).append(value)
        means = {value: float(np.mean(group)) for value, group in groups.items()}
        spread = sum(len(groups[value]) * (mean - values.mean()) ** 2 for value, mean in means.items())
        best, worst = min(means, key=lambda one: means[one]), max(means, key=lambda one: means[one])
        share = float(spread / (len(values) * values.var()))
        effects.append(Influence(column.place, best, means[best], worst, means[worst], share))
    return tuple(sorted(effects, key=lambda one: -one.share))


def parts(
    columns: Sequence[ParameterColumn], names: Sequence[str], rows: Sequence[Row], by: By
) -> Iterator[Part]:
    """Yield the best rows, the influence of the parameters, and what was not measured; `names` as written."""
    best = ranked(rows, by)
    if best:
        yield _best(columns, names, best[:_SHOWN], len(best), by)
    if len(columns) > 1 and len(best) > 2:
        yield _influence(
            dict(zip((column.place for column in columns), columns, strict=True)), names, rows, by
        )
    if not best and any(row.measured.scores is not None for row in rows):
        yield Sentence(
            f"no run has a score for --by {by}: the motion gives nothing that it is counted from", "warning"
        )
    yield from _unmeasured(rows)


def _best(
    columns: Sequence[ParameterColumn], names: Sequence[str], best: Sequence[Row], of: int, by: By
) -> Table:
    shown = [
        Column(_headed(name, column.unit), form="{:g}" if column.kind == "number" else "{}")
        for name, column in zip(names, columns, strict=True)
    ]
    scores = [
        Column("rms rad", form="{:.5f}", missing="-"),
        Column("worst rad", form="{:.4f}", missing="-"),
        Column("overshoot rad", form="{:.4f}", missing="-"),
        Column("settling s", form="{:.3f}", missing="-"),
        Column("energy J", form="{:.2f}"),
        Column("hottest degC", form="{:.1f}"),
        Column("goals reached"),
        Column("skipped", detail=True),
        Column("clamped", detail=True),
    ]
    rows = [(*row.values, *_cells(row.measured.scores)) for row in best if row.measured.scores is not None]
    title = f"the best {len(best)} of {counted(of, 'run', 'runs')} by {by}" if of > 1 else f"by {by}"
    return Table.of(title, [*shown, *scores], rows)


def _cells(scores: Scores) -> tuple[str | float | None, ...]:
    return (
        scores.rms_rad,
        scores.worst_rad,
        scores.overshoot_rad,
        scores.settling_s,
        scores.energy_j,
        scores.temperature_c,
        f"{scores.goals_reached} of {scores.goals}" if scores.goals else "-",
        scores.skipped,
        scores.clamped,
    )


def _influence(
    columns: Mapping[str, ParameterColumn], names: Sequence[str], rows: Sequence[Row], by: By
) -> Table:
    written = dict(zip(columns, names, strict=True))
    mean = f"mean {by} {unit(by)}"
    shown = [
        Column("parameter", "name"),
        Column("best value"),
        Column(mean, form="{:.4g}"),
        Column("worst value"),
        Column(mean, form="{:.4g}"),
        Column("explains", form="{:.0%}"),
    ]
    table = [
        (
            written[one.parameter],
            _with_unit(one.best, columns[one.parameter].unit),
            one.best_mean,
            _with_unit(one.worst, columns[one.parameter].unit),
            one.worst_mean,
            one.share,
        )
        for one in influences(tuple(columns.values()), rows, by)
    ]
    return Table.of(f"what decides about {by}", shown, table)


def _unmeasured(rows: Sequence[Row]) -> Iterator[Part]:
    groups: dict[tuple[Status, str], int] = {}
    for row in rows:
        if row.measured.status != "measured":
            key = (row.measured.status, row.measured.reason)
            groups[key] = groups.get(key, 0) + 1
    shown = sorted(groups.items(), key=lambda one: -one[1])[:_SHOWN]
    columns = (Column("runs"), Column("not measured", "name"), Column("reason", "text"))
    yield Table.of("", columns, ((count, status, reason) for (status, reason), count in shown))


def _headed(name: str, unit_of: str) -> str:
    return f"{name} {unit_of}".strip()


def _with_unit(value: Value, unit_of: str) -> str:
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return f"{text} {unit_of}".strip()
