"""Wishes to the operating system: granted or refused in a plain sentence, never an exception."""

import ctypes
import gc
import os
import resource
import subprocess
import sys
import threading

import pytest

from dxlrun.control import realtime
from dxlrun.control.loop_plan import SchedulerPlan


@pytest.fixture
def asked(monkeypatch):
    """Stand in for the system calls, which would change the tests' own process; return what was asked."""
    calls = []

    class Libc:
        def __getattr__(self, name):
            return lambda *arguments: calls.append(name) or 0

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Libc())
    monkeypatch.setattr(os, "sched_setscheduler", lambda *arguments: calls.append(arguments))
    monkeypatch.setattr(realtime, "freeze_collector", lambda: calls.append("gc"))
    return calls


def test_everything_is_asked_for_and_the_policy_last(asked, monkeypatch):
    monkeypatch.setattr(realtime, "_may_lock", lambda: True)
    grants = realtime.apply(SchedulerPlan("fifo", 40, True))
    assert all(grant.granted for grant in grants[1:])
    (pid, policy, parameters) = asked.pop()
    assert (pid, policy, parameters.sched_priority) == (0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 40)
    assert asked == ["gc", "prctl", "mlockall"]


def test_the_ordinary_policy_asks_for_nothing(asked):
    realtime.apply(SchedulerPlan("other", 31, False))
    assert asked == ["gc", "prctl"]


def test_a_refused_policy_says_how_to_allow_it(asked, monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    grant = realtime.set_policy("round_robin", 31)
    assert not grant.granted
    assert "round_robin 31 was refused" in grant.sentence
    assert "rtprio 32" in grant.sentence


def test_memory_is_not_locked_where_later_allocations_would_fail(asked, monkeypatch):
    monkeypatch.setattr(realtime, "_may_lock", lambda: False)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (8 << 20, 8 << 20))
    grant = realtime.apply(SchedulerPlan("other", 31, True))[-1]
    assert (grant.wish, grant.granted) == ("locked memory", False)
    assert "memlock unlimited" in grant.sentence
    assert "mlockall" not in asked


def test_an_unlimited_allowance_is_enough_to_lock(asked, monkeypatch):
    monkeypatch.setattr(realtime, "_may_lock", lambda: False)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (resource.RLIM_INFINITY,) * 2)
    assert realtime.apply(SchedulerPlan("other", 31, True))[-1].granted
    assert asked[-1] == "mlockall"


def test_another_system_is_told_and_not_a_crash(asked, monkeypatch):
    monkeypatch.setattr(sys, "platform", "plan9")
    monkeypatch.delattr(os, "sched_setscheduler")
    monkeypatch.setattr(realtime, "_may_lock", lambda: True)
    slack, memory, scheduler = realtime.apply(SchedulerPlan("fifo", 40, True))[1:]
    for grant in (slack, memory, scheduler):
        assert not grant.granted
        assert "this system does not offer it" in grant.sentence


def test_a_thread_is_counted():
    before = realtime.thread_count()
    go = threading.Event()
    thread = threading.Thread(target=go.wait)
    thread.start()
    try:
        assert realtime.thread_count() == before + 1
    finally:
        go.set()
        thread.join()


def test_a_real_process_without_rights_gets_plain_sentences():
    """As nobody, with the usual limits: nothing is granted that matters, nothing is raised."""
    script = (
        "import gc, os, resource, json\n"
        "from dxlrun.control import realtime\n"
        "from dxlrun.control.loop_plan import SchedulerPlan\n"
        "resource.setrlimit(resource.RLIMIT_MEMLOCK, (1 << 16, 1 << 16))\n"
        "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
        "if os.getuid() == 0: os.setuid(65534)\n"
        "grants = realtime.apply(SchedulerPlan('round_robin', 31, True))\n"
        "print(json.dumps([[g.wish, g.granted] for g in grants]))\n"
        "print(gc.isenabled(), realtime.thread_count())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.stderr == ""
    assert done.stdout.splitlines() == [
        '[["collector", true], ["timer slack", true], ["locked memory", false], ["scheduler", false]]',
        "False 1",
    ]


def test_the_collector_is_off_and_what_lives_is_frozen():
    script = (
        "import gc\nfrom dxlrun.control import realtime\n"
        "realtime.freeze_collector()\nprint(gc.isenabled(), gc.get_freeze_count() > 1000)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.split() == ["False", "True"]
    assert gc.isenabled()
