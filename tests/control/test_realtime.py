"""Wishes to the operating system: granted or refused in a plain sentence, never an exception."""

import ctypes
import json
import os
import re
import resource
import struct
import subprocess
import sys

import pytest
from tests.kit.awaited import DEADLINE_S

from dxlrun.control import realtime_grants
from dxlrun.control.realtime_grants import Pacing, overshoot_ns
from dxlrun.plan.loop_plan import SchedulerPlan
from dxlwire.clock import MonotonicClock


@pytest.fixture
def asked(monkeypatch):
    """Stand in for the system calls, which would change the tests' own process; return what was asked."""
    calls = []

    class Libc:
        def __getattr__(self, name):
            return lambda *arguments: calls.append(name) or name == "mallopt"

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Libc())
    monkeypatch.setattr(os, "sched_setscheduler", lambda *arguments: calls.append(arguments))
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cores: calls.append(("cores", cores)))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    monkeypatch.setattr(realtime_grants, "freeze_collector", lambda: calls.append("gc"))
    return calls


@pytest.fixture
def may(monkeypatch):
    """Set what this process may: capabilities, and the limits of memory and priority."""

    def set_rights(*capabilities, memlock=8 << 20, rtprio=0, nice=0):
        limits = {
            resource.RLIMIT_MEMLOCK: memlock,
            resource.RLIMIT_RTPRIO: rtprio,
            resource.RLIMIT_NICE: nice,
        }
        monkeypatch.setattr(realtime_grants, "has_capability", lambda bit: bit in capabilities)
        monkeypatch.setattr(resource, "getrlimit", lambda which: (limits[which],) * 2)

    return set_rights


SLICE = ["syscall", "syscall"] if os.uname().machine in realtime_grants._SCHED_CALLS else []
"""What an ordinary process is asked last: a short time slice, and whether it has it."""


def test_everything_is_asked_for_and_the_policy_last(asked, may, monkeypatch, tmp_path):
    may(realtime_grants.IPC_LOCK)
    monkeypatch.setattr(realtime_grants, "IDLE_LATENCY", tmp_path / "cpu_dma_latency")
    realtime_grants.IDLE_LATENCY.touch()
    plan = SchedulerPlan("fifo", 40, True, cores=(0, 1, 2, 3), idle_latency=True)
    grants = realtime_grants.apply_scheduler(plan)
    assert all(grant.granted for grant in grants[1:])
    (pid, policy, parameters) = asked.pop()
    assert (pid, policy, parameters.sched_priority) == (0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 40)
    assert asked == ["gc", "prctl", ("cores", (0, 1, 2, 3)), "mallopt", "mallopt", "mlockall"]
    assert [grant.request for grant in grants[1:]] == [
        "timer slack",
        "cores",
        "memory in place",
        "locked memory",
        "idle latency",
        "scheduler",
    ]
    assert struct.unpack("i", realtime_grants.IDLE_LATENCY.read_bytes()) == (0,)


def test_the_ordinary_policy_asks_for_nothing_that_needs_a_right(asked):
    realtime_grants.apply_scheduler(SchedulerPlan("other", 31, False))
    assert asked == ["gc", "prctl", "mallopt", "mallopt", *SLICE]


def refuse(*_):
    raise PermissionError(1, "Operation not permitted")


def test_a_refused_policy_names_the_consequence_and_the_fix(asked, monkeypatch):
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    grant = realtime_grants.apply_scheduler(SchedulerPlan("round_robin", 31, False))[-1]
    assert not grant.granted
    assert "round_robin 31 was refused" in grant.sentence
    assert "may delay this process" in grant.sentence
    assert "rtprio 32" in grant.fix  # the guardian needs one more
    assert "rtprio 32" in realtime_grants.apply_to_guardian(32, lock=False)[0].fix
    assert grant.full_sentence == f"{grant.sentence}: {grant.fix}"


def test_memory_is_not_locked_where_later_allocations_would_fail(asked, may):
    may()
    grant = realtime_grants.lock_memory()
    assert (grant.request, grant.granted) == ("locked memory", False)
    assert "memlock unlimited" in grant.fix
    assert asked == []


def invalid(*_):
    raise OSError(22, "Invalid argument")


@pytest.mark.parametrize(
    ("asked_for", "changed", "sentence"),
    [
        ((3, 9), {}, "this process cannot run on core 9; it runs on 0, 1, 2, 3"),
        ((9,), {"sched_setaffinity": invalid}, "this process cannot run on core 9; it runs on 0, 1, 2, 3"),
        ((2,), {"sched_getaffinity": lambda _: {2}}, "stays on core 2"),
    ],
)
def test_a_core_that_there_is_not_is_named(asked, monkeypatch, asked_for, changed, sentence):
    for name, function in changed.items():
        monkeypatch.setattr(os, name, function)
    grant = realtime_grants.apply_scheduler(SchedulerPlan("other", 31, False, cores=asked_for))[2]
    assert (grant.granted, grant.sentence) == (sentence.startswith("stays"), sentence)


def test_a_refused_idle_latency_names_the_rule_that_allows_it(asked, monkeypatch):
    monkeypatch.setattr(os, "open", refuse)
    grant = realtime_grants.apply_scheduler(SchedulerPlan("other", 31, False, idle_latency=True))[-1]
    assert (grant.request, grant.granted) == ("idle latency", False)
    assert 'KERNEL=="cpu_dma_latency", OWNER="' in grant.fix


def test_the_guardian_asks_for_one_priority_above_the_loop(asked, may):
    may(realtime_grants.IPC_LOCK)
    locked, scheduler = realtime_grants.apply_to_guardian(32, lock=True)
    assert locked.granted
    assert scheduler.sentence == "scheduler round_robin, priority 32"
    assert realtime_grants.apply_to_guardian(0, lock=False) == ()


@pytest.mark.parametrize(
    ("capabilities", "rtprio", "highest"),
    [((realtime_grants.SYS_NICE,), 0, 99), ((), 0, 0), ((), 40, 40), ((), resource.RLIM_INFINITY, 99)],
)
def test_the_highest_priority_is_what_limit_and_capability_allow(may, capabilities, rtprio, highest):
    may(*capabilities, rtprio=rtprio)
    assert realtime_grants.highest_priority() == highest


def test_a_share_is_raised_as_far_as_the_limit_allows(may):
    may()
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:

        def raised(nice):
            realtime_grants.raise_share(process.pid, nice)
            return os.getpriority(os.PRIO_PROCESS, process.pid)

        own = os.getpriority(os.PRIO_PROCESS, 0)
        assert raised(-10) == own
        may(nice=20 - own + 1)
        assert realtime_grants.lowest_nice() == own - 1
        may(realtime_grants.SYS_NICE)
        if os.geteuid() == 0:  # the right itself, not what this process believes of it
            assert raised(own - 3) == own - 3
            assert raised(own - 1) == own - 3
        assert process.communicate(b"\n")[0] is None
    realtime_grants.raise_share(process.pid, -10)


def test_capabilities_are_read_from_the_kernels_mask(tmp_path):
    status = tmp_path / "status"
    status.write_text("Name:\tx\nCapEff:\t0000000000804000\n")
    assert realtime_grants.has_capability(realtime_grants.SYS_NICE, status)
    assert realtime_grants.has_capability(realtime_grants.IPC_LOCK, status)
    assert not realtime_grants.has_capability(12, status)
    assert not realtime_grants.has_capability(realtime_grants.SYS_NICE, tmp_path / "nothing")


# The margin that is polled


def pacing(most_ns, late, period_ns=20_000_000):
    """Measure with sleeps that wake late by turns; return the clock, the pacing and what was told."""
    clock = MonotonicClock()
    turns = iter(late * 40)
    naps = []
    pace = Pacing(clock, most_ns)
    beats = []
    grant = pace.measure_margin(
        period_ns, lambda: beats.append(1), lambda nap: naps.append(nap) or next(turns)
    )
    assert len(beats) == len(naps) == 32
    assert max(naps) <= period_ns
    return clock, pace, grant


@pytest.mark.parametrize(
    ("most_ns", "late_ns", "period_ns", "margin_ns"),
    [
        (None, [60_000, 80_000], 20_000_000, 120_000),  # what sleeps overshoot and half as much again
        (None, [50_000] * 31 + [9_000_000], 20_000_000, 75_000),  # one in 32 does not count
        (None, [400_000], 2_000_000, 200_000),  # without a word at most a tenth of the period
        (0, [400_000], 20_000_000, 0),  # the file bounds the margin
        (30_000, [400_000], 20_000_000, 30_000),
        (900_000, [400_000], 20_000_000, 600_000),  # and what was measured bounds the file
    ],
)
def test_the_margin_covers_what_sleeps_overshoot_within_its_bounds(most_ns, late_ns, period_ns, margin_ns):
    clock, _, grant = pacing(most_ns, late_ns, period_ns)
    usual_ns = sorted(late_ns)[min(len(late_ns) - 1, 30)]
    assert (clock.spin_ns, grant.granted) == (margin_ns, True)
    assert grant.sentence == (
        f"polls the clock for {margin_ns // 1000} us before each deadline ({margin_ns / period_ns:.1%} of a "
        f"core); 19 of 20 sleeps woke at most {usual_ns // 1000} us late"
        + ", so some cycles begin late"
        * (margin_ns < usual_ns)
    )


def test_a_change_of_rate_keeps_the_share_and_leaves_half_of_a_period_to_others():
    clock, pace, _ = pacing(None, [400_000])
    margins = []
    for period_ns in (20_000_000, 1_000_000, 20_000_000):
        pace.set_period(period_ns)
        margins.append(clock.spin_ns)
    assert margins == [600_000, 100_000, 600_000]
    clock, pace, _ = pacing(1_000_000, [4_000_000])
    pace.set_period(1_000_000)
    assert clock.spin_ns == 500_000


def test_a_sleep_never_wakes_early():
    assert overshoot_ns(1_000) >= 0


# In processes of their own, with the real system calls


def outcome(script):
    """Run a script in a process of its own; return what it printed as JSON."""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=DEADLINE_S
    )
    assert done.stderr == ""
    return json.loads(done.stdout)


WISHES = """
import gc, json, os, resource
from dxlrun.control import realtime_grants
from dxlrun.plan.loop_plan import SchedulerPlan
{before}
plan = SchedulerPlan('round_robin', 31, True, cores=(min(os.sched_getaffinity(0)),), idle_latency=True)
may = (
    realtime_grants.lockable_bytes() == realtime_grants.UNLIMITED, realtime_grants.highest_priority() >= 31
)
grants = realtime_grants.apply_scheduler(plan) + realtime_grants.apply_to_guardian(32, True)
print(json.dumps({{
    "granted": [[one.request, one.granted] for one in grants], "told": [one.full_sentence for one in grants],
    "collector": gc.isenabled(), "threads": realtime_grants.thread_count(), "may": may,
    "policy": os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK, "cores": len(os.sched_getaffinity(0)),
}}))
"""
NOBODY = """
resource.setrlimit(resource.RLIMIT_MEMLOCK, (1 << 16, 1 << 16))
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
if os.getuid() == 0: os.setuid(65534)
"""


SLICED = """
import ctypes, json, os
from dxlrun.control import realtime_grants
from dxlrun.plan.loop_plan import SchedulerPlan
{before}
grants = realtime_grants.apply_scheduler(SchedulerPlan('{policy}', 1, False))
found = ctypes.create_string_buffer(realtime_grants._SCHED_ATTR.size)
ctypes.CDLL(None).syscall(realtime_grants._SCHED_CALLS[os.uname().machine][1], 0, found, len(found), 0)
_, policy, flags, nice, *_, = realtime_grants._SCHED_ATTR.unpack(found.raw)
print(json.dumps({{
    "slice": "time slice" in [one.request for one in grants], "policy": policy, "flags": flags, "nice": nice,
    "runtime": realtime_grants._SCHED_ATTR.unpack(found.raw)[5],
}}))
"""


@pytest.mark.skipif(not SLICE, reason="the numbers of the calls are not known on this architecture")
@pytest.mark.parametrize("before", ["", "os.nice(5)", "import resource" + NOBODY])
def test_an_ordinary_process_has_short_slices_where_the_kernel_gives_them(before):
    found = outcome(SLICED.format(before=before, policy="other"))
    assert found["slice"] == (found["runtime"] == realtime_grants.SLICE_NS)
    nicer = 5 if "nice" in before else 0
    assert (found["policy"], found["nice"]) == (os.SCHED_OTHER, min(os.nice(0) + nicer, 19))
    release = tuple(map(int, re.findall(r"\d+", os.uname().release)[:2]))
    assert found["slice"] == (release >= (6, 12))
    if found["slice"]:
        assert found["flags"] & 1  # children have the usual slices


def test_a_real_process_without_rights_gets_plain_sentences():
    """As nobody, with the usual limits: what needs no right is granted, and nothing is raised."""
    found = outcome(WISHES.format(before=NOBODY))
    granted = dict(found["granted"][:5])
    assert granted == {
        "collector": True,
        "timer slack": True,
        "cores": True,
        "memory in place": True,
        "locked memory": False,
    }
    assert found["granted"][5] == ["idle latency", False]
    rest = [one for one in found["granted"][6:] if one != ["time slice", True]]
    assert rest == [["scheduler", False], ["locked memory", False], ["scheduler", False]]
    assert (found["collector"], found["threads"], found["cores"]) == (False, 1, 1)
    assert found["policy"] == os.SCHED_OTHER
    refused = [
        told for (_, granted), told in zip(found["granted"], found["told"], strict=True) if not granted
    ]
    assert all("Traceback" not in told and "Errno 1" not in told for told in refused)
    assert sum("/etc/security/limits.d/dxlrun.conf" in told for told in refused) == 4


def test_a_real_process_gets_what_its_rights_allow():
    """Root or not, in a container or not: what is told is what the kernel did."""
    found = outcome(WISHES.format(before=""))
    granted = dict(found["granted"])
    lockable, prioritised = found["may"]
    if not lockable:
        assert not granted["locked memory"]
    if not prioritised:
        assert not granted["scheduler"]
    assert (found["policy"] == os.SCHED_RR) == granted["scheduler"]
    assert granted["cores"]
    assert found["cores"] == 1


FAULTS = """
import resource
from dxlrun.control import realtime_grants
{before}
before = sum(resource.getrusage(resource.RUSAGE_SELF)[6:8])
for size in range(100_000, 4_000_000, 100_000):
    bytearray(size)
print(sum(resource.getrusage(resource.RUSAGE_SELF)[6:8]) - before)
"""


def test_touched_memory_is_there_when_it_is_needed():
    """Arrays that come and go, each bigger than the one before: none misses a page once all was prepared."""
    assert outcome(FAULTS.format(before="")) > 100
    assert outcome(FAULTS.format(before="realtime_grants.keep_freed(); realtime_grants.touch_memory()")) < 10
