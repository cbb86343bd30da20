"""`dxlrun doctor`: look whether this machine is fit to run robots."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING

from dxlrun.cli.output.flags import Flag, JsonFlag
from dxlrun.cli.output.terminal import out

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dxlrun.run.doctor import Finding


def doctor(*, as_json: JsonFlag = False, debug: Flag = False) -> int:
    """Look whether this machine is fit to run robots: ports, rights, kernel, processor.

    Nothing is changed; what could be better is told with the command that mends it. Exit code 0, or 1 when
    something is missing without which no robot runs.

    Parameters
    ----------
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    from dxlrun.run.doctor import Machine, diagnose

    findings = diagnose(Machine.this())
    missing = sum(finding.state == "missing" for finding in findings)
    if as_json:
        checks = [asdict(finding) for finding in findings]
        text = json.dumps({"ok": not missing, "checks": checks}, indent=2, ensure_ascii=False)
        out().file.write(text + "\n")
    else:
        _print(findings, missing)
    return 1 if missing else 0


def _print(findings: Sequence[Finding], missing: int) -> None:
    from rich.table import Table
    from rich.text import Text

    console = out()
    colours = {"good": "green", "worse": "yellow", "missing": "bold red"}
    table = Table(box=None, pad_edge=False, show_header=False)
    for one in findings:
        table.add_row(Text(one.what), Text(one.state, colours[one.state]), Text(one.found))
    console.print(table)
    for one in findings:
        if one.mend:  # unbroken: the command is there to be copied
            console.print(Text(f"{one.what}: {one.why}", colours[one.state]), soft_wrap=True)
            console.print(Text(f"    {one.mend}"), soft_wrap=True)
    worse = sum(one.state == "worse" for one in findings)
    verdict = "robots run here" if not missing else "no robot runs here like this"
    console.print(f"{verdict}: {missing} missing, {worse} could be better", soft_wrap=True)
