"""Ranking: the runs of a sweep in order of one score."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from dxlrun.errors import counted
from dxlrun.output.table import Column, Part, Sentence, Table
from dxlrun_lab.sweep import By
from dxlrun_lab.sweep.results import ParameterColumn, Row

_FIELDS: Mapping[By, tuple[str, str]] = {
    "rms": ("rms_rad", "rad"),
    "worst": ("worst_rad", "rad"),
    "overshoot": ("overshoot_rad", "rad"),
    "settling": ("settling_s", "s"),
    "energy": ("energy_j", "J"),
    "temperature": ("temperature_c", "degC"),
}
_SHOWN = 10


def score(row: Row, by: By) -> float | None:
    """Return a run's score; None where it has none."""
    value = getattr(row.measured.scores, _FIELDS[by][0], None)
    return None if value is None else float(value)


def unit(by: By) -> str:
    """Return the unit of a score."""
    return _FIELDS[by][1]


def ranked(rows: Sequence[Row], by: By) -> list[Row]:
    """Return the rows that have a score, the best (lowest) first; equal ones as they were."""
    scored = [(found, row) for row in rows if (found := score(row, by)) is not None]
    return [row for _, row in sorted(scored, key=lambda one: one[0])]


def parts(
    columns: Sequence[ParameterColumn], names: Sequence[str], rows: Sequence[Row], by: By
) -> Iterator[Part]:
    """Yield the best rows and what was not measured; `names` of the parameters as they were written."""
    best = ranked(rows, by)
    if best:
        yield _best(columns, names, best, by)
    elif any(row.measured.scores is not None for row in rows):
        yield Sentence(
            f"no run has a score for --sort {by}: the motion gives nothing that it is counted from", "warning"
        )
    results = (row.measured for row in rows if row.measured.scores is None)
    reasons = Counter((result.status, result.reason) for result in results).most_common(_SHOWN)
    shown = (Column("runs"), Column("not measured", "name"), Column("reason", "text"))
    yield Table.of("", shown, ((count, *why) for why, count in reasons))


def _best(columns: Sequence[ParameterColumn], names: Sequence[str], best: Sequence[Row], by: By) -> Table:
    values = [
        Column(f"{name} {column.unit}".strip(), form="{:g}" if column.kind == "number" else "{}")
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
    rows = []
    for row in best[:_SHOWN]:
        if (one := row.measured.scores) is not None:
            goals = f"{one.goals_reached} of {one.goals}" if one.goals else "-"
            ranks = (getattr(one, field) for field, _ in _FIELDS.values())
            rows.append((*row.values, *ranks, goals, one.skipped, one.clamped))
    runs = counted(len(best), "run", "runs")
    title = f"the best {len(rows)} of {runs} by {by}" if len(best) > 1 else f"by {by}"
    return Table.of(title, [*values, *scores], rows)
