"""`dxlrun doctor`: check whether this machine can run robots, with a fix for each problem."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlrun.cli.inputs import DebugFlag, JsonFlag
from dxlrun.output.terminal import show_json, show_parts

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from dxlrun.output.text_table import Part, Tone
    from dxlrun.run.machine_checks import CheckResult

_TONES: Mapping[str, Tone] = {"good": "good", "worse": "warning", "missing": "error"}


def doctor(*, as_json: JsonFlag = False, debug: DebugFlag = False) -> int:
    """Check whether this machine can run robots: ports, permissions, kernel and processor.

    Nothing is changed. Each possible improvement is printed with the command for it. Exit code: 0, or 1 if
    something is missing without which no robot runs.
    """
    from dxlrun.run.machine_checks import Machine, diagnose

    findings = diagnose(Machine.this())
    missing = sum(finding.state == "missing" for finding in findings)
    if as_json:
        wrong = [f"{one.what}: {one.why}; {one.fix}" for one in findings if one.state == "missing"]
        show_json({"checks": findings}, code=1 if missing else 0, errors=wrong)
    else:
        show_parts(*_findings(findings, missing))
    return 1 if missing else 0


def _findings(findings: Sequence[CheckResult], missing: int) -> Iterator[Part]:
    """Yield the output of `doctor`: a table of all checks, then the fixes, then the verdict."""
    from dxlrun.output.text_table import Cell, Column, Sentence, Table

    columns = (Column("", "name"), Column("", "name"), Column("", "text"))
    rows = ((one.what, Cell(one.state, _TONES[one.state]), one.found) for one in findings)
    yield Table.from_rows("", columns, rows)
    for one in findings:
        if one.fix:
            yield Sentence(f"{one.what}: {one.why}", _TONES[one.state])
            yield f"    {one.fix}"
    worse = sum(one.state == "worse" for one in findings)
    verdict = "robots run here" if not missing else "robots cannot run here yet"
    yield f"{verdict}: {missing} missing, {worse} could be better"
