"""The commands of README.md and docs: each page has a test that runs its own, and those of four are run here.

Where a page names hardware, the command gets a simulated line instead; a run gets virtual time.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dxlrun.cli.simulated import sim
from dxlrun.compile import compile_files
from dxlrun.dynamixel.control_table import control_table
from dxlrun.run.run_summary import RunOptions, RunSummary
from dxlrun.run.simulation_front import Look, Served
from dxlrun.simulation import BusConfig, ServoConfig
from dxlrun.simulation.faults.fault_text import parse_fault
from dxlrun.simulation.process import SimulationConfig

ROOT = Path(__file__).parents[2]
PAGES = {path.name: path.read_text() for path in [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]}
TESTS = {
    "README.md": ("tests/test_readme.py", "tests/cli/test_steer.py"),
    "bench.md": ("tests/bench/test_bench_page.py", "tests/cli/test_docs.py"),
    "bus.md": ("tests/cli/test_docs.py",),
    "controllers.md": ("tests/plugins/test_docs.py",),
    "models.md": ("tests/cli/test_models.py",),
    "real-time.md": ("tests/cli/test_docs.py",),
    "replay.md": ("tests/replay/test_command_line.py",),
    "simulation.md": ("tests/cli/test_sim_page.py", "tests/cli/test_docs.py"),
    "steering.md": ("tests/cli/test_steer.py",),
    "tools.md": ("tests/cli/test_docs.py",),
}
"""What runs the commands of a page."""
Dxlrun = Callable[..., Any]


def commands(page: str) -> list[str]:
    """Return the lines that a reader types, without what is remarked behind them."""
    lines = re.findall(r"^    (dxlrun .+)$", PAGES[page], re.MULTILINE)
    return [line.partition("  #")[0].strip() for line in lines]


def spans(text: str) -> list[str]:
    """Return the commands inside sentences, without `dxlrun`."""
    return re.findall(r"`dxlrun ([^`]+)`", " ".join(text.split()))


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The directory that the reader stands in, with the robots and motions of the clone."""
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[SimulationConfig]:
    """What `dxlrun sim` was about to serve."""
    asked: list[SimulationConfig] = []

    def serve(config: SimulationConfig, *_: object, **__: object) -> Served:
        asked.append(config)
        return Served(1.0, Look(), ())

    monkeypatch.setattr(sim, "_serve", serve)
    return asked


def test_every_page_with_commands_has_a_test_that_runs_them() -> None:
    assert {page for page in PAGES if commands(page)} == set(TESTS)
    for page, paths in TESTS.items():
        for path in paths:
            assert page in (ROOT / path).read_text(), (page, path)


@pytest.mark.parametrize("page", PAGES)
def test_commands_inside_sentences_exist_with_their_options(dxlrun: Dxlrun, page: str) -> None:
    general = dxlrun("--help").out
    verbs = set(re.findall(r"^│ ([a-z]+) ", general, re.MULTILINE))
    for span in spans(PAGES[page]):
        verb, *rest = span.split()
        if verb.startswith("--") or verb.endswith((".yaml", "FILE", "ROBOT")):
            helped = general
        else:
            assert verb in verbs, span
            family = [verb, rest[0]] if verb == "bench" else [verb]
            helped = dxlrun(*family, "--help").out
        for option in re.findall(r"--[a-z][a-z-]*", span):
            assert option in helped, span


def test_bus_md_its_checks_say_what_the_page_says(dxlrun: Dxlrun, clone: Path) -> None:
    split, ftdi = [line for line in commands("bus.md") if " check " in line]
    assert "read:=split" in split
    told = dxlrun(*shlex.split(split)[1:])
    assert (told.code, told.err) == (0, "")
    refused = dxlrun(*shlex.split(ftdi)[1:])
    assert refused.code == 2
    (highest,) = re.findall(r"highest rate that is left, (\d+ Hz)", PAGES["bus.md"])
    assert highest in refused.err + refused.out


def test_bus_md_the_simulation_and_the_robot_meet_at_the_link(
    dxlrun: Dxlrun, clone: Path, served: list[SimulationConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both as processes: tests/cli/test_sim.py; the fault, too: tests/run/test_unplugs.py."""
    simulate, run = [line for line in commands("bus.md") if " check " not in line]
    (robot,) = re.findall(r"```yaml\n(name: pan_tilt.*?)```", PAGES["README.md"], re.DOTALL)
    (clone / "robot.yaml").write_text(robot)
    assert dxlrun(*shlex.split(simulate)[1:]).code == 0
    ((bus,),) = (config.buses for config in served)
    assert len(bus.servos) == 2
    ports: list[str] = []

    def run_robot(plan: Any, options: RunOptions, out: object) -> RunSummary:
        ports.extend(one.port for one in plan.buses)
        return RunSummary(0, "ended", 1, 0, 0.1, ())

    monkeypatch.setattr("dxlrun.run.supervisor.run_robot", run_robot)
    assert dxlrun(*shlex.split(run)[1:]).code == 0
    assert ports == [shlex.split(simulate)[-1]]
    (fault,) = re.findall(r"then type: (.+)$", PAGES["bus.md"], re.MULTILINE)
    assert str(parse_fault(fault)) == fault


def test_tools_md_its_commands_do_what_they_say(
    dxlrun: Dxlrun, clone: Path, simulated_line: Callable[..., Any]
) -> None:
    path, finish = simulated_line(BusConfig("main", 1_000_000, (ServoConfig(1, "XM430-W350", 2.0),), 2.0))
    scan, synopsis, *servo = commands("tools.md")
    assert synopsis == "dxlrun servo PORT ID VERB"
    assert len(servo) == 3
    found = dxlrun(*scan.replace("/dev/ttyUSB0", path).split()[1:], "--baud", "1000000", "--ids", "1-9")
    assert (found.code, found.err) == (0, "")
    assert "XM430-W350" in found.out
    for line in servo:  # EEPROM is written without a question here; the rate is given, to be quick
        told = dxlrun(*shlex.split(line.replace("/dev/ttyUSB0", path))[1:], "--yes", "--baud", "1000000")
        assert (told.code, told.err) == (0, ""), line
    assert '"id":7' in (clone / "elbow.json").read_text().replace(" ", "")
    sent = [entry.data for entry in finish() if entry.direction == "in"]
    writes = {(data[4], data[8], data[10:-2]) for data in sent if data[2:3] == b"\xfd" and data[7] == 3}
    items = control_table("XM430-W350").items
    assert (1, items["return_delay_time"].address, b"\x00") in writes
    assert (1, items["id"].address, b"\x07") in writes


@pytest.mark.parametrize("page", ["tools.md", "simulation.md"])
def test_simulations_inside_sentences_are_understood(
    dxlrun: Dxlrun, clone: Path, served: list[SimulationConfig], page: str
) -> None:
    lines = [span for span in spans(PAGES[page]) if span.startswith("sim --")]
    for line in lines:
        assert dxlrun(*shlex.split(line)).code == 0, line
    assert len(served) == len(lines)
    assert lines or page != "tools.md"


@pytest.mark.parametrize("page", ["real-time.md", "bench.md", "simulation.md"])
def test_a_log_is_compared_with_its_ledger_as_the_page_says(dxlrun: Dxlrun, clone: Path, page: str) -> None:
    analyze = next(line for line in commands(page) if " analyze " in line and "--ledger" in line)
    runs = [line for line in commands(page) if line.startswith("dxlrun robots/")]
    run = runs[0] if runs else "dxlrun robots/single_joint.yaml --duration 60 --ledger logs/of.ledger.jsonl"
    (clone / "logs").mkdir()
    ran = dxlrun(*shlex.split(re.sub(r"--duration \d+", "--duration 0.2 --virtual", run))[1:])
    assert ran.code == 0, ran.err
    (log,) = (clone / "logs").glob("*.mcap")
    ledger = shlex.split(run)[-1]
    given = {"LOG": str(log), "logs/*.mcap": str(log), "FILE": ledger, "LEDGER": ledger}
    words = [given.get(word, word) for word in shlex.split(analyze)[1:]]
    told = dxlrun(*[ledger if word.endswith("*.ledger.jsonl") else word for word in words])
    assert told.code == 0, told.out + told.err
    assert re.match(r"The log is what (the bus|all \d+ buses) saw, to the byte", told.out)


@pytest.mark.parametrize("robot", sorted((ROOT / "robots").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_robot_of_the_clone_is_checked_and_runs(
    dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert dxlrun("check", robot).code == 0
    ran = dxlrun(robot, "--virtual", "--duration", "0.1")
    assert ran.code == 0, ran.err
    cycles = round(0.1e9 / compile_files(robot, {}, []).plan.loop.period_ns)
    assert f"{cycles} cycles, 0 periods skipped" in ran.out
