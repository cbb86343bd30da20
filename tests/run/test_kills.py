"""Campaign: kill -9 of a process of a run at a random moment, set-up and shutdown included; never the servos.

Judged by the simulated bus' ledger alone: every byte sent is a legal instruction, torque ends off on all
servos, nothing switches it on again once it was cut. And: the log can be read, no process is left.

CI runs 3 kills. The full campaign before a release; each test prints its victim and moment:

    pytest --campaign=release tests/run/test_kills.py -rA
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import accumulate
from pathlib import Path
from typing import Any

from tests.kit.campaigns import campaign

VICTIMS = ("run.loop_process", "run.guardian", "log.recorder", "dxlrun")
"""The terminal's own process is "dxlrun"."""
LATEST_S = {"process": 1.8, "wire": 0.5}
"""Half of the moments are counted from the start of the victim's process: loading, set-up, running and the
end take about so long. The others from the first byte on the wire, which a slow wire keeps busy with the
set-up."""
Start = Callable[..., Any]


def heard(run: Any) -> bytes:
    """Return by the ledger what the servos heard."""
    return b"".join(entry.data for entry in run.ledger() if entry.direction == "in")


def stage(run: Any) -> str:
    """Say by the ledger how far the robot had come."""
    wire = heard(run)
    if not wire:
        return "before the first byte"
    if b"\x83\x1e" in wire:
        return "after the first goals"
    return "in the set-up, torque on" if bytes((24, 1)) in wire else "in the set-up, before torque"


def test_the_log_of_a_run_that_is_killed_beside_busy_programs_lacks_its_end_only(
    start: Start, wait_for: Callable[..., Any], wire_and_log: Callable[..., Any]
) -> None:
    """The docs say 0.5 s. The ledger may lack its own last 0.5 s; the bound here is for a busy machine."""
    run = start("--duration", "60")
    run.wait_until_moving()
    before_ns = run.ledger()[-1].t_ns
    with busy_programs(3):  # beside them a start takes too long
        wait_for(lambda: run.ledger()[-1].t_ns > before_ns + 2_000_000_000, "2 s on the wire")
        for process in run.processes().values():
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
    run.finish()
    wait_for(run.gone, "the end of every process")
    for wire, ours in wire_and_log(run):
        both = min(len(wire), len(ours))
        assert wire[:both] == ours[:both]
    ledger, (wire, ours) = run.ledger(), next(wire_and_log(run))
    heard = [entry for entry in ledger if entry.direction == "in"]
    ends = accumulate(len(entry.data) for entry in heard)
    missing = [entry.t_ns for entry, end in zip(heard, ends, strict=True) if end > len(ours)]
    assert not missing or missing[-1] - missing[0] < 2_000_000_000
    assert "its last cycle is at" in run.log().damage[0]


@contextmanager
def busy_programs(count: int) -> Iterator[None]:
    """Keep the processor busy."""
    programs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


@campaign(ci=3, night=15, release=60)
def test_a_kill_leaves_the_robot_limp(  # noqa: PLR0917  fixtures
    start: Start,
    tmp_path: Path,
    number: int,
    chance: random.Random,
    wait_for: Callable[..., Any],
    all_limp: Callable[[Any], bool],
    never_on_again: Callable[[Any], bool],
) -> None:
    victim, since = VICTIMS[number % len(VICTIMS)], chance.choice(tuple(LATEST_S))
    after_s = round(chance.uniform(0.0, LATEST_S[since]), 3)
    print(f"kill of {victim} {after_s} s after {since}")
    robot = tmp_path / "slow.yaml"
    text = (tmp_path / "pair.yaml").read_text()
    robot.write_text(text.replace("1_000_000", "19_230").replace("rate: 50", "rate: 20"))
    run = start("--duration", "0.6", robot=robot)
    wait_for(lambda: run.processes().get(victim) or run.process.poll() is not None, f"the {victim}")
    if since == "wire":
        wait_for(lambda: heard(run) or run.process.poll() is not None, "the first byte")
    threading.Event().wait(after_s)
    process = run.processes().get(victim)  # a run may be over before a late kill: that is judged the same
    if process is not None:
        os.kill(process, signal.SIGKILL)
    code, _, err = run.finish()
    wait_for(run.gone, "the end of every process")
    assert "Traceback" not in err
    assert all_limp(run)
    assert never_on_again(run)
    if victim != "dxlrun":
        assert code in (0, 1)
    if code == 0:
        assert err == ""
    if run.one("*.mcap") is not None and heard(run):
        run.log()
    print(f"{victim} killed {'after the end' if process is None else stage(run)}")
