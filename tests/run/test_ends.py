"""Ways out of a run: the cases of ends.txt, judged by ledger, processes and log."""

import os
import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from tests.kit.awaited import until
from tests.kit.cases import TextCase, fits, read_cases, read_form
from tests.kit.live_run import MOST_HELD, ROBOT, LiveRuns, Running, together

from dxlrun_analysis.report import analyze

TEXT = Path(__file__).with_name("ends.txt")
MODULES = {
    "guardian": "run.guardian",
    "loop": "run.loop_process",
    "recorder": "log.recorder",
    "simulation": "run.simulation_process",
    "terminal": "dxlrun",
}
EXCEPTIONS = (
    "torque may stay on",
    "a packet may be missing",
    "the log may be incomplete",
    "the ledger lacks its end",
)
"""Lines that see nothing: they except a case from what holds of every other one."""
SIGNALS = {"kill": signal.SIGKILL, "stop": signal.SIGSTOP}


def read_groups() -> dict[str, list[TextCase]]:
    """Return the cases that run at the same time, by the name of their group."""
    found: dict[str, list[TextCase]] = {}
    for case in read_cases(TEXT):
        if case.name.startswith("== "):
            group = found[case.name.removeprefix("== ")] = []
        else:
            group.append(case)
    return found


def lines_after(case: TextCase, word: str) -> list[str]:
    """Return what follows a word in the lines that begin with it."""
    return [line.text.removeprefix(word) for line in case.lines if line.text.startswith(word)]


def begin(case: TextCase, runs: LiveRuns, folder: Path) -> Running:
    """Start the run of a case, in a folder of its own."""
    folder.mkdir()
    text = ROBOT
    for change in lines_after(case, "robot: "):
        right, _, wrong = change.partition(" => ")
        assert right in text or change.startswith("+ "), f"{right} is not in the robot"
        text = f"{text}{change[2:]}\n" if change.startswith("+ ") else text.replace(right, wrong)
    (folder / "robot.yaml").write_text(text)
    options = " ".join(lines_after(case, "options: ")).split()
    code = {word: line for word in ("configure", "update") for line in lines_after(case, f"{word}: ")}
    where = {"robot": folder / "robot.yaml", "directory": folder}
    return runs.start_odd(*options, **code, **where) if code else runs.start(*options, **where)


def pan_goals(run: Running) -> list[int]:
    """Return the goals of pan that cycles sent, ticks."""
    sent = (entry.data for entry in run.ledger() if entry.direction == "in")
    return [int.from_bytes(data[8:10], "little") for data in sent if data[4:8] == bytes((0x83, 30, 4, 3))]


WHEN: dict[str, Callable[[Running], object]] = {
    "the guardian is there": lambda run: run.child("run.guardian"),
    "the loop is there": lambda run: run.child("run.loop_process"),
    "configured": lambda run: (run.directory / "configured").exists(),
    "cycles are in the log": lambda run: run.log_path() and run.sent() and len(run.log().cycles),
    "pan has another goal": lambda run: len(set(pan_goals(run))) > 1,
}


def perform(run: Running, line: str) -> None:
    """Wait until something is so, then do one thing after another."""
    when, _, actions = line.partition(": ")
    if when == "moving":
        run.wait_until_moving()
    else:
        until(lambda: WHEN[when](run), when, check=run.lives)
    done = [action.split() for action in actions.split(", ")]
    pids = {words[-1]: run.child(MODULES[words[-1]]) for words in done if words[-1] in MODULES}
    for verb, *names in done:
        if verb == "delete":
            path = run.log_path()
            assert path is not None
            path.unlink()
        elif verb in SIGNALS:
            os.kill(pids[names[0]], SIGNALS[verb])
        else:
            run.signal({"interrupt": signal.SIGINT, "terminate": signal.SIGTERM}[verb])


has = partial(fits, whole=False)


class Judge:
    """What is seen of a run that is over."""

    def __init__(self, run: Running, hit_ns: int) -> None:
        self.run, self.hit_ns = run, hit_ns
        self.code, self.out, self.err = run.finish()
        until(run.gone, "the end of every process")

    def sees(self, seen: str) -> bool:
        """Check one line of a case."""
        return seen in EXCEPTIONS or bool(read_form(CHECKS, seen)(self))

    def reports(self, pattern: str) -> bool:
        return any(has(event.text, pattern) for event in self.run.log().events)

    def has_periods(self, seconds: str) -> bool:
        """Each period has a cycle or is skipped; all joints were read; the loop waited of its own accord."""
        log = self.run.log()
        last = int(log.cycles["cycle"][-1]) + 1
        assert any(message["loop_voluntary"] > 0 for message in log.messages("/machine"))
        assert log.cycles["valid"].any(axis=0).all()
        return len(log.cycles) + log.cycles["skipped"].sum() == last <= 50 * float(seconds)

    def spans(self, seconds: str) -> bool:
        times = [entry.t_ns for entry in self.run.ledger()]
        return times[-1] - times[0] > float(seconds) * 1e9

    def is_off_within(self, seconds: str) -> bool:
        after_s = (self.run.last_sent_ns() - self.hit_ns) * 1e-9
        print(f"torque off {after_s:.2f} s after the signals")
        return 0 < after_s < float(seconds)

    def judge_rest(self, said: list[str]) -> None:
        """Check what holds of every case that says nothing else."""
        if not {"torque stays on", "torque may stay on"} & {*said}:
            assert self.run.is_limp()
            assert self.run.is_never_on_again()
        if "a traceback is written" not in said:
            assert "Traceback" not in self.err, self.err
        if "the log may be incomplete" in said:
            assert self.run.log_path() is None or self.run.log().cycles is not None
        elif "no log" not in said and self.run.log_path() is not None:
            assert self.run.log().complete
            if "the ledger lacks its end" not in said:
                assert self.run.wire_is_logged(MOST_HELD if "a packet may be missing" in said else 0)


CHECKS: dict[str, Callable[..., object]] = {
    r"exit (\d+)": lambda judge, code: judge.code == int(code),
    "says nothing": lambda judge: judge.err == "",
    r"says less than (\w+) characters": lambda judge, count: len(judge.err) < int(count),
    "says only (.*)": lambda judge, text: len(judge.err.splitlines()) == 1 and has(judge.err, text),
    "says (.*)": lambda judge, text: has(judge.err, text),
    "prints (.*)": lambda judge, text: has(judge.out, text),
    "does not print (.*)": lambda judge, text: text not in judge.out + judge.err,
    "no log": lambda judge: judge.run.log_path() is None,
    "the log has cycles": lambda judge: len(judge.run.log().cycles) > 0,
    r"the log has every period of ([\d.]+) s": Judge.has_periods,
    r"the ledger has ([\d.]+) s": Judge.spans,
    "the log reports (.*)": Judge.reports,
    "the guardian reports (.*)": lambda judge, text: has(judge.run.guardians_word(), text),
    "the analysis says (.*)": lambda judge, text: text in analyze(judge.run.log()).verdict.sentences,
    "nothing is sent": lambda judge: judge.run.sent() == b"",
    "no torque is given": lambda judge: not any(on for _, on in judge.run.torque_changes()),
    r"torque is off within ([\d.]+) s": Judge.is_off_within,
    r"the last goal of pan is (\d+) ticks": lambda judge, ticks: pan_goals(judge.run)[-1] == int(ticks),
    r"the last goal of pan is below (\d+) ticks.*": lambda judge, ticks: (
        pan_goals(judge.run)[-1] < int(ticks)
    ),
    "torque stays on": lambda judge: not judge.run.is_limp(),
    "a traceback is written": lambda judge: "Traceback" in judge.err,
}


def check(case: TextCase, runs: LiveRuns, folder: Path) -> None:
    run, hit_ns = begin(case, runs, folder), 0
    for line in lines_after(case, "when "):
        perform(run, line)
        hit_ns = time.monotonic_ns()
    judge, said = Judge(run, hit_ns), lines_after(case, "=> ")
    for seen in said:
        assert judge.sees(seen), (seen, judge.code, judge.out, judge.err)
    judge.judge_rest(said)


GROUPS = read_groups()


@pytest.mark.timeout(300)  # several runs
@pytest.mark.parametrize("name", GROUPS)
def test_ways_out_of_a_run(name: str, live_runs: LiveRuns, tmp_path: Path) -> None:
    cases = {
        f"{one.place}: {one.name}": (one, live_runs, tmp_path / str(at))
        for at, one in enumerate(GROUPS[name])
    }
    assert cases
    together(check, cases)
