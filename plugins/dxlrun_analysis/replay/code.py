"""Choice of the robot file's Python files that a replay executes: those on disk or in the log.

A log can come from an untrusted source, so the Python text in it is executed only on request.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from msgspec.structs import replace

from dxlrun import InputError
from dxlrun.tooling.robots import published_by, read_file
from dxlrun_analysis.replay.recorded_inputs import RecordedPlan

CodeChoice = Literal["current", "log"]
"""Python files that a replay executes. `current`: those next to the robot file, as they are now. `log`:
the texts in the log."""


def with_code(plan: RecordedPlan, choice: CodeChoice | None) -> tuple[RecordedPlan, tuple[str, ...]]:
    """Return the plan with the Python files that the replay executes, and remarks on changed ones.

    Without a choice, the files on disk must equal those in the log.

    Raises:
        InputError: A file differs from the log and no choice was made, or a file cannot be read.
    """
    code = {name: text for name, text in plan.included.items() if name.endswith(".py")}
    if not code:
        return plan, ()
    folder = Path(plan.source_file).parent
    now = {name: _text(folder, name) for name in code}
    changed = sorted(name for name, text in code.items() if now[name] != text)
    if choice == "log":
        return plan, tuple(
            f"{name} has changed since the run; the replay ran the version in the log" for name in changed
        )
    missing = [name for name in changed if now[name] is None]
    if choice is None and changed:
        raise InputError("\n".join(_refusal(folder, name, gone=name in missing) for name in changed))
    if missing:
        raise InputError("\n".join(f"--code current: {folder / name} cannot be read" for name in missing))
    texts = {**plan.included, **{name: text for name, text in now.items() if text is not None}}
    controllers = published_by(plan.loop.controllers, {name: texts[name] for name in changed})
    return replace(plan, included=texts, loop=replace(plan.loop, controllers=controllers)), ()


def _text(folder: Path, name: str) -> str | None:
    """Return the text of a file next to the robot file, or None if it cannot be read."""
    if Path(name).name != name:
        return None  # Compilers write only plain file names, so a path is an attempt to read other files
    try:
        return read_file(folder / name).decode("utf-8")
    except (OSError, ValueError):
        return None


def _refusal(folder: Path, name: str, *, gone: bool) -> str:
    state = "cannot be read" if gone else "has changed since the run"
    current = "" if gone else "--code current to run the present file, or "
    return (
        f"{folder / name} {state}; write {current}--code log to run the code in the log "
        "if you trust its sender"
    )
