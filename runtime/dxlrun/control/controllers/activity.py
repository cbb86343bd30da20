"""Activity: the controller whose code runs now, shown to other processes; what that code must not start.

A thread beside the loop would be handed the interpreter in the middle of a cycle, and a forked child has the
loop's memory and stops the loop while it is made. Both are refused to controllers while the robot runs: where
Python starts them the start itself fails; threads that foreign machine code starts are counted after the
call, its processes are not seen. A process that a controller needs is started in on_configure.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import ClassVar, ParamSpec

import numpy as np

from dxlrun.channels.heartbeat import ControllerMethod, Heartbeat
from dxlrun.errors import ControllerFault, counted

_TRACEBACK = 6000
P = ParamSpec("P")
_LOADING = int(ControllerMethod.ON_CONFIGURE)
"""The last method before the robot runs."""
# found at once, twice a call
_ident, _process = threading.get_ident, os.getpid


def is_interrupt(error: BaseException) -> bool:
    """Return whether what foreign code seems to raise is Ctrl-C of the process that it runs in.

    In the loop's own process SIGINT is ignored: there, as for all other exceptions, it is that code's. A
    handler of this package raises in a frame of its own, which that code cannot be the last of.
    """
    handler = signal.getsignal(signal.SIGINT)
    if type(error) is not KeyboardInterrupt or handler is signal.SIG_IGN:
        return False
    if handler is signal.default_int_handler:
        return True  # its frame is not seen
    raised_in = [
        str(frame.f_globals.get("__name__", "")) for frame, _ in traceback.walk_tb(error.__traceback__)
    ]
    return raised_in[-1].startswith("dxlrun.")


class Activity:
    """What is called now of which controller.

    `count_threads` returns the number of threads, in a process that must have no other than the loop's;
    without it other threads come and go.
    """

    guarded: ClassVar[Activity | None] = None
    """The one whose controller must start nothing now; a process runs one loop at a time."""

    def __init__(self, page: Heartbeat | None = None, count_threads: Callable[[], int] | None = None) -> None:
        self._page = page
        self._count_threads = count_threads
        self._threads = count_threads() if count_threads else 0
        self._process = _process()
        self._names: dict[int, str] = {}
        self.thread = 0
        """Which thread calls the controller."""
        self.refused = ""
        """What was refused to the controller in this call."""
        _guard()

    def name_controller(self, place: int, name: str) -> None:
        """Name the controller in this place, before anything of it is called."""
        self._names[place] = name
        if self._page is not None:
            self._page.name_controller(place, name)

    def show(self, place: int, method: ControllerMethod) -> None:
        """Show what is called next of the controller in this place."""
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
        """Call a method of the controller in this place; `kind` is that of the command it is given.

        Raises ControllerFault for what it raises, and for what it starts while the robot runs. A child that
        it forked and that came back from the call ends here: there is one loop only.
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
        except BaseException as error:  # foreign code: it must not take the loop along
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
                f"{started} in {what}: while the robot runs that would stop the loop; "
                "start a process in on_configure instead"
            )
        elif isinstance(raised, ControllerFault):  # the context refused something, in a sentence of its own
            text = str(raised)
        else:
            error = " ".join(f"{type(raised).__name__}: {raised}".split())
            text = f"raised in {what}: {error}{_line_of(raised)}"
        fault = ControllerFault(f"controller {self._names[place]} {text}")
        if raised is not None:
            fault.add_note("".join(traceback.format_exception(raised))[-_TRACEBACK:])
        return fault


def _line_of(raised: BaseException | None) -> str:
    """Return the line of the author's code that raised, in brackets, or that called what raised."""
    frames = traceback.extract_tb(None if raised is None else raised.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(_NOT_THE_AUTHORS)]
    return f" ({os.path.basename(own[-1].filename)}:{own[-1].lineno})" if own else ""


_NOT_THE_AUTHORS = (str(Path(__file__).parents[2]), str(Path(np.__file__).parent))
"""Folders of code that an author of a controller cannot correct: dxlrun's, and numpy's."""
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
"""Audit events (docs.python.org, Audit events table) that come before something is started."""


def _refuse(what: str) -> None:
    """Raise RuntimeError in a controller that starts something while the robot runs."""
    activity = Activity.guarded
    if activity is not None and activity.thread == _ident():
        activity.refused = what
        raise RuntimeError(f"a controller cannot start {what} while the robot runs")


def _audit(event: str, _: tuple[object, ...]) -> None:
    if event in _STARTS:
        _refuse(_STARTS[event])


@cache
def _guard() -> None:
    """Check every start of a thread or a process from now on.

    Before Python 3.12 no audit event reports a thread, and none reports the processes of multiprocessing
    that are not forked.
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
