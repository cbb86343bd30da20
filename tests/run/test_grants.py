"""What the operating system granted: a table on a terminal, remarks elsewhere, all of it in the log."""

import io
import os
import signal
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace
from rich.console import Console

from dxlrun.channels.child_processes import spare_core
from dxlrun.channels.event_records import EventCode
from dxlrun.control.realtime_grants import Grant, highest_priority, lowest_nice
from dxlrun.run.loop_process import beside_simulation
from dxlrun.run.run_processes import RECORDER_NICE
from dxlrun.run.run_summary import granted_text, refusals, show_grants
from dxlrun.testing import plan_of

pytestmark = pytest.mark.long

GRANTS = (
    Grant("timer slack", True, "timer slack 1 ns"),
    Grant("scheduler", False, "it was refused, so that", "allow it with `a long command`"),
    Grant("scheduler", False, "it was refused", "allow it with `a long command`", "guardian"),
)


def shown(
    grants: tuple[Grant, ...], *, terminal: bool = True, verbose: bool = False
) -> tuple[str, tuple[str, ...]]:
    """Return what is printed of grants, and what remains as remarks."""
    text = io.StringIO()
    out = Console(file=text, force_terminal=terminal, width=60, no_color=True, highlight=False)
    show_grants(grants, out, verbose=verbose)
    return text.getvalue(), refusals(grants, out)


def test_a_terminal_gets_a_table_others_remarks_and_the_log_all():
    table, remarks = shown(GRANTS)
    lines = table.splitlines()
    assert len(lines) == 2 + len(GRANTS) + 1  # head, rule, grants, fix
    assert lines[2].split()[:3] == ["timer", "slack", "yes"]
    assert "guardian: scheduler" in lines[4]
    assert lines[5].count("allow it with `a long command`") == 1, "once, and unbroken"
    assert remarks == ()
    fix = "allow it with `a long command`"
    each = f"it was refused, so that: {fix}", f"guardian: it was refused: {fix}"
    assert shown(GRANTS, terminal=False) == ("", each)
    assert granted_text(GRANTS) == {
        "timer slack": "yes: timer slack 1 ns",
        "scheduler": "no: it was refused, so that",
        "guardian: scheduler": "no: it was refused",
    }
    assert shown(GRANTS[:1])[0] == "real time: all granted\n"
    assert "timer slack" in shown(GRANTS[:1], verbose=True)[0]


ROBOT = """\
name: wisher
buses: {m: {port: sim, protocol: 1.0, baud_rate: 1_000_000}}
loop:
  rate: 100
  tolerated_skips: 100 %  # without rights and on a busy machine the loop may stand still
  scheduler: {policy: fifo, priority: 30, lock_memory: true, cores: [0], idle_latency: true}
joints: {j: {bus: m, id: 3, model: AX-12A, reference: 150 deg, direction: 1}}
"""
REQUESTS = [
    "collector",
    "cores",
    "idle latency",
    "locked memory",
    "memory in place",
    "polling",
    "scheduler",
    "timer slack",
]


WITHOUT_RIGHTS = """
import ctypes, os, resource, sys
for capability in range(64):
    ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP: also root gets none at the next exec
resource.setrlimit(resource.RLIMIT_MEMLOCK, (1 << 16, 1 << 16))
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
os.execv(sys.argv[1], sys.argv[1:])
"""


@pytest.mark.parametrize("before", [(), (sys.executable, "-c", WITHOUT_RIGHTS)], ids=["as is", "no rights"])
def test_a_run_reports_what_it_was_granted(start, tmp_path, before):
    """Once with the rights of the user of the tests, once without capabilities and limits."""
    robot = tmp_path / "wisher.yaml"
    robot.write_text(ROBOT)
    run = start("--duration", "0.2", robot=robot, before=before)
    code, _, err = run.finish()
    assert code == 0, err
    log = run.log()
    granted = log.metadata["granted"]
    loops = [name for name in granted if not name.startswith("guardian")]
    assert sorted(set(loops) - {"time slice"}) == REQUESTS  # that where the policy was refused
    assert sorted(set(granted) - set(loops)) == ["guardian: locked memory", "guardian: scheduler"]
    told = [event for event in log.events if event.code == EventCode.SCHEDULER]
    assert [event.source for event in told].count("guardian") == 2
    assert len(told) == len(granted)
    refused = [name for name, text in granted.items() if text.startswith("no")]
    assert len(err.splitlines()) == len(refused)
    if before:
        assert {"locked memory", "scheduler", "guardian: locked memory", "guardian: scheduler"} <= set(
            refused
        )


def test_nothing_but_what_asked_for_it_has_the_real_time_of_the_terminal(start):
    if highest_priority() < 31:
        pytest.skip("this account has no real time to give")
    run = start(gateway=True, before=("chrt", "-r", "31"))
    run.wait_until_moving()
    run.child("dxlrun.remote")
    found = {
        name: {
            os.sched_getscheduler(int(task.name)) & ~os.SCHED_RESET_ON_FORK
            for task in Path(f"/proc/{pid}/task").iterdir()
        }
        for name, pid in run.processes().items()
    }
    nice = os.getpriority(os.PRIO_PROCESS, run.child("dxlrun.log.recorder"))
    run.signal(signal.SIGTERM)
    run.finish()
    ours = {"run.guardian", "run.loop_process", "run.simulation_process"}
    assert found.keys() - ours == {"dxlrun", "log.recorder", "remote"}
    assert nice == max(RECORDER_NICE, min(0, lowest_nice()))
    assert all(found[name] == {os.SCHED_OTHER} for name in found.keys() - ours)
    assert all(os.SCHED_OTHER not in found[name] for name in ours)


@pytest.mark.parametrize(
    ("taken", "core"), [((), 3), ((3,), 2), ((1, 2, 3), 0), ((0, 1, 2, 3), 3), ((77,), 3)]
)
def test_simulated_servos_stay_off_the_cores_of_the_loop_where_they_can(monkeypatch, taken, core):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    assert spare_core(taken) == core


@pytest.mark.parametrize(
    ("port", "policy", "cores", "allowed", "stays"),
    [
        ("sim", "fifo", (), {0, 1, 2, 3}, (0, 1, 2)),
        ("sim", "fifo", (1,), {0, 1, 2, 3}, (1,)),
        ("sim", "fifo", (), {0}, ()),
        ("sim", "other", (), {0, 1}, ()),
        ("/dev/ttyUSB0", "fifo", (), {0, 1}, ()),
    ],
)
def test_a_loop_in_real_time_stays_off_the_core_of_simulated_servos(  # noqa: PLR0917  fixtures
    monkeypatch, port, policy, cores, allowed, stays
):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: allowed)
    plan = plan_of(Path(__file__).parents[2] / "robots" / "diff_drive.yaml")
    scheduler = replace(plan.loop.scheduler, policy=policy, cores=cores)
    buses = tuple(replace(bus, port=port) for bus in plan.buses)
    plan = replace(plan, buses=buses, loop=replace(plan.loop, scheduler=scheduler))
    assert beside_simulation(plan) == replace(scheduler, cores=stays)
