"""Sweep: every point of a grid that its file does not have yet is measured, and kept at once."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import msgspec
from msgspec import structs

from dxlrun.errors import InputError
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.plan.robot_plan import Plan, to_json
from dxlrun_lab.sweep.grid import Grid, Point
from dxlrun_lab.sweep.measuring import AGAIN, Measured, Task, versions_for
from dxlrun_lab.sweep.ranges import Value
from dxlrun_lab.sweep.results import (
    ParameterColumn,
    Row,
    SweepHeader,
    difference,
    digest,
    read_results,
    write_results,
)
from dxlrun_lab.sweep.workers import Worker, measured

WRITE_S = 1.0
"""Rows that are lost, and measured again, when the command is killed: those of so long."""
Progress = Callable[[str, float], None]
"""Takes a text and the share that is done."""


class Sweep:
    """The points of a grid and the rows of a file.

    Raises InputError when the file is one of another sweep, LogError when it is none.
    """

    def __init__(self, grid: Grid, header: SweepHeader, output: Path, time_limit_s: float) -> None:
        self.grid, self.header, self.output = grid, header, output
        self._time_limit_s = time_limit_s
        self._rows: dict[str, Row] = {}
        self._points: dict[str, tuple[Value, ...]] = {}
        """The runs of the grid, in its order, as far as it was gone through."""
        self.there = self.measured = 0
        """Points that were in the file before, and rows that were added, with scores or without."""
        self._written_s = time.monotonic()
        if output.exists():
            other, rows = read_results(output)
            if what := difference(header, other):
                raise InputError(f"--output {output} holds a sweep of {what}; choose another --output")
            self._rows = {row.run: row for row in rows}

    @property
    def rows(self) -> tuple[Row, ...]:
        """The rows that there are: of the grid in its order, then those of other ranges."""
        own = [self._rows[run] for run in self._points if run in self._rows]
        return (*own, *(row for run, row in self._rows.items() if run not in self._points))

    def run(
        self, workers: Callable[[], AbstractContextManager[Sequence[Worker]]], progress: Progress
    ) -> None:
        """Measure what is missing, and keep it, however this ends; workers are used only if something is.

        Raises InputError when the file cannot be written.
        """
        began = time.monotonic()
        tasks = self.missing()
        try:
            first = next(tasks, None)
            if first is None:
                return
            progress(f"{self.grid.size} runs: starting", 0.0)
            with workers() as found:
                for run, result in measured(found, itertools.chain([first], tasks)):
                    self._keep(run, result)
                    progress(*self._remaining(time.monotonic() - began))
        finally:
            self._write()

    def missing(self) -> Iterator[Task]:
        """Yield the runs that are to be measured, in the order of the grid; keep the others' rows."""
        for point in self.grid.points:
            task = self._task(point)
            run = task.run if isinstance(task, Task) else digest(msgspec.json.encode(self.grid.values(point)))
            self._points[run] = self._numbers(point)
            row = self._rows.get(run)
            if row is not None and row.measured.status not in AGAIN:
                self.there += 1
            elif isinstance(task, Task):
                yield task
            else:
                self._keep(run, task)

    def _task(self, point: Point) -> Task | Measured:
        """Return the run of a point, or its result where the robot file does not allow it."""
        try:
            compiled = self.grid.compiled(point)
        except InputError as error:
            return Measured("refused", " ".join(error.sentences))
        plan = without_names(compiled.plan)
        text, paths = to_json(plan), self.grid.paths(compiled)
        run = digest(msgspec.json.encode((self.grid.values(point), paths, versions_for(plan))), text)
        return Task(run, text, paths, self._time_limit_s)

    def _numbers(self, point: Point) -> tuple[Value, ...]:
        return tuple(
            parameter.cells[index] for parameter, index in zip(self.grid.parameters, point, strict=True)
        )

    def _keep(self, run: str, result: Measured) -> None:
        self._rows[run] = Row(run, self._points[run], result)
        self.measured += 1
        if time.monotonic() - self._written_s > WRITE_S:
            self._write()

    def _write(self) -> None:
        if self.measured:
            write_results(self.output, self.header, self.rows)
        self._written_s = time.monotonic()

    def _remaining(self, elapsed_s: float) -> tuple[str, float]:
        done = self.there + self.measured
        left_s = round(elapsed_s / max(1, self.measured) * (self.grid.size - done))
        text = f"{done} of {self.grid.size} runs, {left_s // 60}:{left_s % 60:02d} left"
        return text, done / self.grid.size


def header_of(grid: Grid, arguments: Mapping[str, str], command: str) -> SweepHeader:
    """Return what a sweep is of."""
    plan = grid.first.plan
    named = {**plan.included, "": plan.urdf or ""}
    texts = (plan.source_text, *(f"{name}\0{text}" for name, text in sorted(named.items())))
    return SweepHeader(
        robot=plan.robot,
        robot_file=digest(*(text.encode() for text in texts)),
        motions=tuple(digest(text.encode()) for text in grid.motions),
        arguments=dict(arguments),
        parameters=tuple(
            ParameterColumn(
                parameter.place_text,
                parameter.unit,
                "number" if isinstance(parameter.cells[0], float) else "word",
            )
            for parameter in grid.parameters
        ),
        versions=versions_for(plan),
        command=command,
    )


def default_name(header: SweepHeader) -> str:
    """Return the name of the file of a sweep: another robot file, motion or parameter has another."""
    of = msgspec.structs.replace(header, command="")
    return f"{header.robot}-{digest(msgspec.json.encode(of))[:8]}.parquet"


def without_names(plan: Plan) -> Plan:
    """Return a plan without what says only where it comes from."""
    commands = tuple(structs.replace(command, origin="") for command in plan.loop.commands)
    loop = structs.replace(plan.loop, commands=commands)
    return structs.replace(
        plan,
        loop=loop,
        source_file="",
        source_text="",
        included={name: text for name, text in plan.included.items() if name.endswith(".py")},  # is executed
        played={},
        arguments={},
        recording=RecordingPlan(),
    )
