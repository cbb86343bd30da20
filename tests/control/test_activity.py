"""What a controller's code must not start while the robot runs, and how others see whose code it is."""

import _thread
import ctypes
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial

import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.loops import Scripted

from dxlrun.channels.event_records import EventCode
from dxlrun.channels.heartbeat import ControllerMethod, Heartbeat, create
from dxlrun.control import realtime_grants
from dxlrun.control.controllers.activity import Activity
from dxlrun.errors import ControllerFault

CALLS = {
    "activate": "on_activate",
    "update": "update",
    "command": "on_command (go)",
    "deactivate": "on_deactivate",
}


def thread():
    threading.Thread(target=int).start()


def pool():
    with ThreadPoolExecutor(1) as workers:
        workers.submit(int).result()


def swallowed():
    with suppress(RuntimeError):
        os.fork()


STARTS = [
    (thread, "a thread"),
    (pool, "a thread"),
    (os.fork, "a child process"),
    (os.forkpty, "a child process"),
    (swallowed, "a child process"),
    (lambda: os.system("/bin/true"), "a child process"),  # noqa: S605  what is to be refused
    (lambda: os.posix_spawn("/bin/true", ["true"], {}), "a child process"),
    (lambda: subprocess.run(["/bin/true"], check=False), "a child process"),
    (multiprocessing.get_context("fork").Process(target=int).start, "a child process"),
    (multiprocessing.get_context("spawn").Process(target=int).start, "a child process"),
    (lambda: os.execv("/bin/true", ["true"]), "another program in place of the loop"),  # noqa: S606  see above
]


def children():
    return set(multiprocessing.active_children()), threading.active_count()


@pytest.mark.parametrize("at", CALLS)
@pytest.mark.parametrize(("start", "what"), STARTS)
def test_what_a_controller_starts_while_the_robot_runs_is_refused_and_its_fault(robot, at, start, what):
    before = children()

    def act(controller, step, time_ns, value):
        if step == at:
            start()

    robot.script("odd", act).send(40_000_000, "odd", "go", 1.0)
    result = robot.run(5)
    assert result.reason == "fault"
    assert result.detail.startswith(f"controller odd tried to start {what} in {CALLS[at]}; this would stop")
    ((_, fault),) = robot.events.of(EventCode.CONTROLLER_FAULT)
    assert fault.startswith(result.detail)
    assert ("Traceback" in fault) == (start is not swallowed)
    assert children() == before


def test_an_event_at_the_end_of_the_process_is_no_error(page, monkeypatch):
    """The interpreter clears the globals of modules, and then still closes files."""
    assert breach(Activity(page, lambda: 1), int) == ""
    monkeypatch.setattr("dxlrun.control.controllers.activity._STARTS", None)
    sys.audit("os.remove", "file", -1)


def test_processes_are_for_on_configure_and_threads_of_others_are_theirs(robot):
    go, done = threading.Event(), threading.Event()

    def elsewhere():
        go.wait()
        thread()
        done.set()

    other = threading.Thread(target=elsewhere, daemon=True)
    other.start()

    class Good(Scripted):
        def on_configure(self, context):
            assert subprocess.run(["/bin/true"], check=False).returncode == 0
            thread()

        def act(self, step, time_ns, value):
            if step == "update":
                go.set()
                assert done.wait(DEADLINE_S)

    result = robot.add("good", Good, command=("position", "velocity")).run(2)
    other.join()
    assert (result.reason, result.detail) == ("stopped", "")


NEVER = "in update; this would stop the running loop: start a process in on_configure instead"


def breach(activity, call, method=ControllerMethod.UPDATE):
    """Return which rule a call of the controller arm broke."""
    activity.name_controller(0, "arm")
    try:
        activity.call(0, method, "", call)
    except ControllerFault as fault:
        return str(fault).removeprefix("controller arm ")
    return ""


@pytest.fixture
def page():
    descriptor = create()
    made = Heartbeat(descriptor)
    os.close(descriptor)
    return made


def test_a_thread_that_no_hook_sees_is_counted_once_and_only_while_the_robot_runs(page):
    threads = [1]
    activity = Activity(page, lambda: threads[0])
    steps = (ControllerMethod.ON_CONFIGURE, *[ControllerMethod.UPDATE] * 3)
    started = [
        breach(activity, partial(threads.__setitem__, 0, count), step)
        for step, count in zip(steps, (2, 2, 4, 3), strict=True)
    ]
    assert started == ["", "", f"started 2 threads {NEVER}", ""]


@pytest.fixture
def no_thread_ends():
    """Wait until the threads of earlier tests have ended: one that ends meanwhile hides one that begins."""
    counts = []
    while len(counts) < 20 or len(set(counts[-20:])) > 1:
        time.sleep(0.005)
        counts.append(realtime_grants.thread_count())


def test_the_count_sees_a_thread_of_foreign_machine_code(page, no_thread_ends):
    libc = ctypes.CDLL(None)
    run = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
    go = threading.Event()
    body = run(lambda _: go.wait() and None)
    handle = ctypes.c_ulong()
    activity = Activity(page, realtime_grants.thread_count)
    begin = partial(libc.pthread_create, ctypes.byref(handle), None, body, None)
    assert breach(activity, begin) == f"started 1 thread {NEVER}"
    go.set()
    libc.pthread_join(handle, None)


def test_after_a_call_everything_can_be_started_again(page):
    activity = Activity(page)

    def act():
        with pytest.raises(RuntimeError, match="a controller cannot start a thread while the robot runs"):
            thread()

    assert breach(activity, act) == f"tried to start a thread {NEVER}"
    assert breach(activity, int) == ""
    thread()
    _thread.start_new_thread(int, ())


def test_the_page_names_what_is_called_until_it_returns(page):
    seen = []
    activity = Activity(page)
    for place, name in ((0, "arm"), (62, "h\u00e4nd" * 100)):
        activity.name_controller(place, name)
    for place in (0, 62):
        for step in tuple(ControllerMethod)[1:]:
            activity.call(place, step, "", lambda: seen.append(page.activity))
            assert not page.activity
    calls = ["__init__", "on_configure", "on_activate", "update", "on_command", "on_deactivate"]
    calls += ["on_goal", "on_cancel", "on_parameters", "on_hold", "on_restart"]
    assert seen[: len(calls)] == [f"{call} of controller arm" for call in calls]
    assert seen[len(calls)].startswith("__init__ of controller h\u00e4ndh\u00e4nd")
    assert page.beats == page.cycles == 0


FOREIGN_FORK = """
import ctypes, os
from dxlrun.channels.heartbeat import ControllerMethod, Heartbeat, create
from dxlrun.control.controllers.activity import Activity
memory = create()
activity, children = Activity(Heartbeat(memory)), []
fork = ctypes.PyDLL(None).fork  # no audit event reports it
activity.call(0, ControllerMethod.UPDATE, "", lambda: children.append(fork()))
if children == [0]:
    os._exit(1)  # the child came back
os._exit(os.waitstatus_to_exitcode(os.waitpid(children[0], 0)[1]))
"""


def test_a_child_that_foreign_machine_code_forked_ends_with_the_call():
    """In a process with one thread, as the loop has: other threads can stop the child for ever."""
    subprocess.run([sys.executable, "-c", FOREIGN_FORK], check=True)
