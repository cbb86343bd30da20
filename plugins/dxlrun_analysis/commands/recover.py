"""`dxlrun recover`: a whole log of one that is unfinished or damaged."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dxlrun.cli.inputs import Flag, JsonFlag
from dxlrun.errors import InputError, counted
from dxlrun.output.table import Sentence
from dxlrun.output.terminal import err, show, show_json


def recover(
    log: Path,
    output: Annotated[Path | None, Parameter(name="output", show_default=False)] = None,
    /,
    *,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Make a whole, indexed log of one that is unfinished or damaged; nothing is written over.

    Parameters
    ----------
    log
        An .mcap file whose recorder was killed, or that is damaged; or the directory of a log in parts.
    output
        A new file, or a new directory for a log in parts; without it beside the log, with _recovered in its
        name.
    as_json
        Print what became of each file as JSON.
    debug
        Print the traceback of an error.
    """
    if not log.exists():
        raise InputError(f"there is no log {log}; a run prints at its end where its log is")
    from dxlrun.log.target import check_new, new_target
    from dxlrun_analysis.export.recover import recover_log

    target = output or log.with_name(f"{log.name.removesuffix('.mcap')}_recovered{log.suffix}")
    check_new(target)
    with err().status(f"recovering {log}"), new_target(target) as beside:
        result = recover_log(log, beside)
    if as_json:
        show_json({"output": str(target), "files": result.files, "missing": result.missing})
        return 0
    for name, file in result.files.items():
        lost = f", {file.lost_messages} lost" if file.lost_messages else ""
        show(f"{name}: {counted(file.messages, 'message', 'messages')} recovered{lost}")
        show(*(Sentence(f"  {sentence}", "warning") for sentence in file.sentences))
    show(*(Sentence(sentence, "warning") for sentence in result.missing))
    show("nothing was wrong with it" if result.whole else "", f"log: {target}")
    return 0
