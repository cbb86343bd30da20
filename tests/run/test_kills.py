"""Campaign: kill -9 of a process of a run at a random moment, judged by the simulated bus' ledger alone."""

import os
import random
import signal
import threading
from pathlib import Path

from tests.kit.awaited import until
from tests.kit.campaigns import campaign
from tests.kit.live_run import ROBOT, Running, Start, together

VICTIMS = ("run.loop_process", "run.guardian", "log.recorder", "dxlrun")
"""The terminal's own process is "dxlrun"."""
LATEST_S = {"process": 1.8, "wire": 0.5}
"""Half of the moments are counted from the start of the victim's process: loading, set-up, running and the
end take about so long. The others from the first byte on the wire, which a slow wire keeps busy with the
set-up."""
SLOW = ROBOT.replace("1_000_000", "19_230").replace("rate: 50", "rate: 20")


def stage(run: Running) -> str:
    """Return by the ledger how far the robot had come."""
    wire = run.sent()
    if not wire:
        return "before the first byte"
    if b"\x83\x1e" in wire:
        return "after the first goals"
    return "in the set-up, torque on" if bytes((24, 1)) in wire else "in the set-up, before torque"


@campaign(ci=2, night=15, release=60)
def test_a_kill_leaves_the_robot_limp(
    start: Start, tmp_path: Path, amount: float, chance: random.Random
) -> None:
    def check(victim: str, since: str, after_s: float, folder: Path) -> None:
        folder.mkdir()
        (folder / "slow.yaml").write_text(SLOW)
        run = start("--duration", "0.6", robot=folder / "slow.yaml", directory=folder)

        def ended() -> bool:
            return run.process.poll() is not None

        until(lambda: run.processes().get(victim) or ended(), f"the {victim}")
        if since == "wire":
            until(lambda: run.sent() or ended(), "the first byte")
        threading.Event().wait(after_s)
        process = run.processes().get(victim)  # a run may be over before a late kill: that is judged the same
        if process is not None:
            os.kill(process, signal.SIGKILL)
        code, _, err = run.finish()
        until(run.gone, "the end of every process")
        assert "Traceback" not in err
        assert run.is_limp()
        assert run.is_never_on_again()
        if victim != "dxlrun":
            assert code in (0, 1)
        if code == 0:
            assert err == ""
        if run.log_path() is not None and run.sent():
            run.log()
        when = "after the end" if process is None else stage(run)
        print(f"{victim} killed {after_s} s after {since}: {when}")

    cases = {}
    for number in range(int(amount)):
        victim, since = VICTIMS[number % len(VICTIMS)], chance.choice(tuple(LATEST_S))
        after_s = round(chance.uniform(0.0, LATEST_S[since]), 3)
        cases[f"{number}: {victim} {after_s} s after {since}"] = (
            victim,
            since,
            after_s,
            tmp_path / str(number),
        )
    together(check, cases, most=3)
