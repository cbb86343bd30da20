"""Activity: publish which controller's code the loop runs, and refuse threads and processes it starts.

A second thread could take the interpreter lock in the middle of a cycle. A fork copies the loop's memory map
and stalls the loop for that time. Controllers must not start either while the robot runs. A start by Python
code fails at once. Threads of native code are counted after the call; processes of native code are not
detected. A controller starts the processes that it needs in on_configure.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import ClassVar, ParamSpec

import numpy as np

from dxlrun.channels.heartbeat import ControllerMethod, Heartbeat
from dxlrun.errors import ControllerFault, counted

# Characters. The end of a traceback has the line that raised, and the text of an event has 8192 at most.
_TRACEBACK = 6000
P = ParamSpec("P")
_LOADING = int(ControllerMethod.ON_CONFIGURE)
"""Number of the last controller method that may start threads: those up to on_configure precede the run."""
# Bound here because each call of a controller uses both twice.
_ident, _process = threading.get_ident, os.getpid


def is_interrupt(error: BaseException) -> bool:
    """Return whether an exception from foreign code is a Ctrl-C of its process.

    The loop's own process ignores SIGINT, so a KeyboardInterrupt is the foreign code's own there. A signal
    handler of this package raises in its own frame, so the last frame of the traceback is in dxlrun.
    """
    handler = signal.getsignal(signal.SIGINT)
    if type(error) is not KeyboardInterrupt or handler is signal.SIG_IGN:
        return False
    if handler is signal.default_int_handler:
        return True  # the default handler is C code without a Python frame
    raised_in = [
        str(frame.f_globals.get("__name__", "")) for frame, _ in traceback.walk_tb(error.__traceback__)
    ]
    return raised_in[-1].startswith("dxlrun.")


class Activity:
    """Calls methods of controllers, and publishes the current call in shared memory for the guardian.

    Args:
        page: Shared memory for the name of the controller and of the method; None publishes nothing.
        count_threads: Returns the number of threads of this process. Used in a process that must not have
            more threads after a call than before; None allows other threads.
    """

    guarded: ClassVar[Activity | None] = None
    """Instance whose controller is being called while the robot runs, so it must not start threads or
    processes; None: no call. A process runs only one loop.
    """

    def __init__(self, page: Heartbeat | None = None, count_threads: Callable[[], int] | None = None) -> None:
        self._page = page
        self._count_threads = count_threads
        self._threads = count_threads() if count_threads else 0
        self._process = _process()
        self._names: dict[int, str] = {}
        self.thread = 0
        """Identifier of the thread that called the controller last."""
        self.refused = ""
        """Description of the thread or process that the controller tried to start in this call; empty: none.
        """
        _guard()

    def name_controller(self, place: int, name: str) -> None:
        """Set the name of the controller with this index. Must precede the first call of the controller."""
        self._names[place] = name
        if self._page is not None:
            self._page.name_controller(place, name)

    def publish_method(self, place: int, method: ControllerMethod) -> None:
        """Publish the controller (by its index) and the method that run from now on, without calling them."""
        if self._page is not None:
            self._page.call(place, method)

    def call(
        self,
        place: int,
        method: ControllerMethod,
        kind: str,
        call: Callable[P, object],
        *arguments: P.args,
        **named: P.kwargs,
    ) -> None:
        """Call a method of a controller, publish the call, and convert any exception to ControllerFault.

        A forked child that returns from the call exits here: there must be only one loop.

        Args:
            place: Index of the controller.
            method: Method that is called, for other processes and messages.
            kind: Kind of the command that is passed; empty: no command.
            call: The bound method, with its arguments.

        Raises:
            ControllerFault: The method raised, or started a thread or a process while the robot runs.
        """
        page = self._page
        if page is not None:
            page.call(place, method)
        if method > _LOADING:
            self.thread = _ident()
            Activity.guarded = self
        raised: BaseException | None = None
        try:
            call(*arguments, **named)
        except BaseException as error:  # foreign code must not end the loop
            if is_interrupt(error):
                raise
            raised = error
        finally:
            if _process() != self._process:
                os._exit(0)
            Activity.guarded = None
            if page is not None:
                page.call(0, 0)
        started = ""
        if self._count_threads is not None and (more := self._count_threads() - self._threads) > 0:
            self._threads += more
            started = f"started {counted(more, 'thread', 'threads')}" if method > _LOADING else ""
        if self.refused:
            started, self.refused = f"tried to start {self.refused}", ""
        if raised is not None or started:
            raise self._fault(
                place, f"{method} ({kind})" if kind else f"{method}", started, raised
            ) from raised

    def _fault(self, place: int, what: str, started: str, raised: BaseException | None) -> ControllerFault:
        if started:
            text = (
                f"{started} in {what}; this would stop the running loop: "
                "start a process in on_configure instead"
            )
        elif isinstance(raised, ControllerFault):  # raised by the context, with a complete sentence
            text = str(raised)
        else:
            error = " ".join(f"{type(raised).__name__}: {raised}".split())
            text = f"raised in {what}: {error}{_line_of(raised)}"
        fault = ControllerFault(f"controller {self._names[place]} {text}")
        if raised is not None:
            fault.add_note("".join(traceback.format_exception(raised))[-_TRACEBACK:])
        return fault


def _line_of(raised: BaseException | None) -> str:
    """Return file and line, in the controller author's code, that raised, as ` (wave.py:12)`.

    Empty if unknown.
    """
    frames = traceback.extract_tb(None if raised is None else raised.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(_NOT_THE_AUTHORS)]
    return f" ({os.path.basename(own[-1].filename)}:{own[-1].lineno})" if own else ""


_NOT_THE_AUTHORS = (str(Path(__file__).parents[2]), str(Path(np.__file__).parent))
"""Folders of dxlrun and numpy. Their lines in tracebacks are skipped: the author of a controller cannot
correct them."""
_STARTS = {
    "os.fork": "a child process",
    "os.forkpty": "a child process",
    "os.posix_spawn": "a child process",
    "os.system": "a child process",
    "_winapi.CreateProcess": "a child process",
    "subprocess.Popen": "a child process",
    "os.exec": "another program in place of the loop",
    "_thread.start_new_thread": "a thread",
    "_thread.start_joinable_thread": "a thread",
}
"""Python audit events that report the start of a process or thread, with its description (docs.python.org,
Audit events table).
"""


def _refuse(what: str) -> None:
    """Raise RuntimeError if a controller calls this while the robot runs, and note `what` as refused."""
    activity = Activity.guarded
    if activity is not None and activity.thread == _ident():
        activity.refused = what
        raise RuntimeError(
            f"a controller cannot start {what} while the robot runs; start a process in on_configure"
        )


def _audit(event: str, _: tuple[object, ...], starts: Mapping[str, str] = _STARTS) -> None:
    # The last events of a process come when modules have already lost their globals.
    if event in starts:
        _refuse(starts[event])


@cache
def _guard() -> None:
    """Install the checks that refuse threads and processes of controllers, once a process.

    Audit events alone are not sufficient: before Python 3.12 none reports threads, and none reports
    multiprocessing's processes that are not forked.
    """
    sys.addaudithook(_audit)
    start: Callable[[threading.Thread], None] = threading.Thread.start

    def start_thread(thread: threading.Thread) -> None:
        _refuse("a thread")
        start(thread)

    setattr(threading.Thread, "start", start_thread)  # noqa: B010  a method, which mypy would not let replace
    if sys.platform == "win32":
        return
    import _posixsubprocess

    fork_exec: Callable[..., int] = _posixsubprocess.fork_exec

    def start_process(*arguments: object) -> int:
        _refuse("a child process")
        return fork_exec(*arguments)

    setattr(_posixsubprocess, "fork_exec", start_process)  # noqa: B010  see above
