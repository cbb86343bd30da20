"""`dxlrun latency` on the command line: counts and structure, never times."""

import ctypes
import os
import resource
import shutil
import signal
import subprocess
import sys
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.answers import read_answer, result_of
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.commands import Dxlrun
from tests.kit.pages import page_commands

from dxlrun.log.log_reader import read_log
from dxlrun_analysis.latency import latency_log
from dxlrun_analysis.latency.conditions import Settings
from dxlrun_analysis.latency.statistics import Block
from dxlrun_lab import stress
from dxlrun_lab.latency import latency_measurement

pytestmark = pytest.mark.long

PROGRAM = [sys.executable, "-m", "dxlrun"]


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Keep logs in the test's directory, and the load small."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(stress, "MOST_MEMORY", 1 << 20)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.needs("report")
def test_comparison_from_the_command_line_to_the_log(dxlrun: Dxlrun, tmp_path: Path) -> None:
    words = ("--count", 50, "--period", "1ms", "--blocks", 2, "--stress", "--compare", "other,c")
    found = dxlrun("latency", *words, "--report", "page.html", "--json")
    assert (found.code, found.err) == (0, "")
    result = result_of(found.out)
    ours, yardstick = result["conditions"]
    assert (ours["label"], yardstick["label"]) == ("other", "c (other)")
    assert (ours["wake_ups"], yardstick["wake_ups"]) == (50, 50)
    assert (result["reference"], set(ours["ratios"])) == ("c", {"mean_us", "p99_us"})
    assert (ours["polling_us"] > 0, yardstick["polling_us"]) == (True, 0)
    assert all(0 < one["processor_share"] <= 1.1 for one in (ours, yardstick))
    assert (result["interrupted"], result["failure"]) == (False, "")
    assert "busy process" in result["load"]
    assert (tmp_path / "page.html").read_text().count("<figure") == 3
    analyzed = dxlrun("analyze", result["log"], "--json", "--report", "again.html")
    assert analyzed.code == 0
    assert result_of(analyzed.out)["conditions"] == result["conditions"]
    assert (tmp_path / "again.html").is_file()
    assert dxlrun("analyze").out.startswith(f"log: {result['log']}\n\nWake-up latency, period 1 ms, 2 blocks")
    one, two = dxlrun("analyze", result["log"], result["log"]).out.splitlines()
    assert one == two
    assert one.startswith(f"{result['log']}: Wake-up latency")
    refused = dxlrun("replay", result["log"])
    assert (refused.code, len(refused.errors)) == (2, 1)


def test_log_that_the_disk_has_no_room_for_fails_and_the_table_is_shown(
    dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrote = latency_log.write_log
    full = "writing the log stopped: No space left on device"
    monkeypatch.setattr(latency_log, "write_log", lambda *words: replace(wrote(*words), error=full))
    words = ("latency", "--count", 20, "--blocks", 1, "--log")
    found = dxlrun(*words, "here.mcap")
    assert (found.code, found.errors) == (1, [f"dxlrun: the log here.mcap is incomplete: {full}"])
    assert "wake-ups" in found.out
    found = dxlrun(*words, "there.mcap", "--json")
    answer = read_answer(found.out)
    assert (found.code, found.err, "conditions" in answer.result) == (1, "", True)
    assert [one.what for one in answer.errors] == [f"the log there.mcap is incomplete: {full}"]


def test_one_condition_as_a_table(dxlrun: Dxlrun) -> None:
    found = dxlrun("latency", "--count", 20, "--blocks", 1, "--log", "here.mcap")
    assert found.code == 0
    first, *lines = found.out.splitlines()
    assert first == "measuring other: 20 wake-ups in 1 block, 0.0 s"
    heads = [line.split()[0] for line in lines if line.strip()]
    assert {"wake-ups", "maximum"} <= set(heads)
    assert lines[-1] == "log: here.mcap"
    again = dxlrun("latency", "--count", 20, "--log", "here.mcap")
    sentence = "dxlrun: here.mcap cannot be written (it exists); choose another name"
    assert (again.code, again.errors) == (2, [sentence])


def test_without_a_compiler_the_yardstick_is_refused(dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    found = dxlrun("latency", "--compare", "other,c")
    assert found.code == 2
    assert found.errors == [
        "dxlrun: c of --compare needs the C compiler cc; install a compiler (Debian, Ubuntu: "
        "`sudo apt install gcc`), or omit c"
    ]
    monkeypatch.setenv("CC", sys.executable)
    (error,) = dxlrun("latency", "--compare", "other,c").errors
    assert error.startswith("dxlrun: c of --compare was not compiled: ")
    monkeypatch.setenv("CC", "/no/such/cc")
    (error,) = dxlrun("latency", "--compare", "other,c").errors
    assert error.endswith("/no/such/cc did not run: No such file or directory")


def without_rights() -> None:
    """Take the right to real time from the process that is executed next."""
    ctypes.CDLL(None).prctl(24, 23, 0, 0, 0)  # PR_CAPBSET_DROP, CAP_SYS_NICE; without effect unless root
    with suppress(ValueError):
        resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))


def test_without_the_right_to_real_time_nothing_is_measured(tmp_path: Path) -> None:
    words = ("latency", "--count", "50", "--compare", "other,round_robin", "--priority", "40")
    found = subprocess.run(
        [*PROGRAM, *words], capture_output=True, text=True, check=False, preexec_fn=without_rights
    )
    assert (found.returncode, found.stdout) == (2, "")
    (error,) = found.stderr.splitlines()
    assert error.startswith("dxlrun: nothing was measured: scheduler round_robin 40 was refused")
    assert "allow it with `echo '" in error
    assert "rtprio 41' | sudo tee -a" in error
    assert list(tmp_path.iterdir()) == []


def measuring(process: int) -> bool:
    """Return whether a process has wake-ups in a buffer; of its blocks, not of the first check of rights."""
    for link in Path(f"/proc/{process}/fd").iterdir():
        with suppress(OSError):
            if "memfd:wake_ups" in str(link.readlink()):
                return int.from_bytes(link.read_bytes()[:8], sys.byteorder) > 10
    return False


@pytest.mark.needs("report")
@pytest.mark.parametrize("page", ["experiments.md", "real-time.md", "raspberry-pi.md"])
def test_commands_of_a_page_are_understood(
    dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch, page: str
) -> None:
    """They measure nothing here: each condition has one wake-up in each block."""

    def measure(settings: Settings, *others: Any) -> None:
        *_, measured = others
        for number in range(settings.blocks):
            times = np.array([[0, 1_000 + number]])
            measured.blocks += [Block(one.name, number, times, 1, 9) for one in settings.conditions]

    monkeypatch.setattr(latency_measurement, "measure_blocks", measure)
    monkeypatch.setattr(latency_measurement, "require_grants", lambda *_: ())
    monkeypatch.setattr(latency_measurement, "compiled_yardstick", lambda *_: nullcontext(""))
    monkeypatch.setattr(latency_measurement, "keep_cores_awake", lambda *_: None)
    lines = [words for words in page_commands(page) if words[0] == "latency"]
    assert lines
    for words in lines:
        found = dxlrun(*words, "--no-record")
        assert (found.code, found.err) == (0, ""), words
        assert "Wake-up latency, period 1 ms, 5 blocks" in found.out


@pytest.mark.parametrize("kill", [False, True])
def test_what_was_measured_is_kept(tmp_path: Path, kill: bool) -> None:
    words = ("latency", "--count", "600000", "--log", str(tmp_path / "kept.mcap"), "--json")
    pipe = subprocess.PIPE
    with subprocess.Popen([*PROGRAM, *words], stdout=pipe, stderr=pipe, text=True) as running:
        until(lambda: measuring(running.pid))
        if kill:
            children = Path(f"/proc/{running.pid}/task/{running.pid}/children").read_text().split()
            os.kill(int(children[0]), signal.SIGKILL)
        else:
            os.kill(running.pid, signal.SIGTERM)  # as Ctrl-C
        shown, errors = running.communicate(timeout=DEADLINE_S)
    result = result_of(shown)
    (one,) = result["conditions"]
    assert one["wake_ups"] > 10
    assert (running.returncode, result["interrupted"]) == ((1, False) if kill else (130, True))
    assert result["failure"] == ("the measuring process of other exited (SIGKILL)" if kill else "")
    assert (one["processor_share"] is None) == kill
    (topic,) = read_log(tmp_path / "kept.mcap").topics.values()
    assert len(topic.data) == one["wake_ups"]
    assert errors == ""
