"""Run of `dxlrun` that is started for an experiment as a child process, and ends with the experiment."""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from dxlrun import ProcessFault, RemoteRobot
from dxlrun.tooling.live import SocketLink, sockets

_CODE = """
import ctypes, runpy, signal
ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG: it ends with the experiment
runpy.run_module("dxlrun", run_name="__main__", alter_sys=True)
"""
_CREDENTIALS = struct.Struct("=3i")
START_S = 60.0
"""Timeout for the start of a run, s: compilation, loading of plug-ins, set-up of the servos"""
END_S = 30.0
"""Timeout for the exit of the run after SIGTERM, s; then it gets a second one, and at last SIGKILL"""
_POLL_S = 0.05


class OwnRun:
    """Run of a robot in a child process. Its output is only shown if it fails.

    The process has its own session, so that Ctrl-C only reaches the experiment. It ends cleanly when the
    process of the experiment has exited.
    """

    def __init__(self, words: Sequence[str]) -> None:
        """Start `dxlrun` with these words: a robot file and its arguments."""
        self._stdout = tempfile.TemporaryFile()  # noqa: SIM115  open as long as the run lasts
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115  as above
        self._stopping = False
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _CODE, *words],
            stdin=subprocess.DEVNULL,
            stdout=self._stdout,
            stderr=self._stderr,
            start_new_session=True,
        )

    def listening(self, abort: Callable[[], str | None]) -> RemoteRobot | None:
        """Wait until the run listens and has had a cycle, and connect to it.

        Returns:
            The connection, or None if `abort` returned a reason.

        Raises:
            ProcessFault: The run has ended, or did not start within START_S.
        """
        until = time.monotonic() + START_S
        while abort() is None:
            if self._process.poll() is not None:
                raise ProcessFault("\n".join(self._sentences()) or "the run ended during its start")
            for name, path in sockets().items():
                if _parent_of_listener(path) == self._process.pid:
                    robot = RemoteRobot(name, SocketLink(path, "experiment"))
                    if robot.info()["cycles"]:
                        return robot
                    robot.close()
            if time.monotonic() > until:
                raise ProcessFault(f"the run did not start within {START_S:g} s")
            time.sleep(_POLL_S)
        return None

    def end_run(self) -> tuple[str, ...]:
        """End the run cleanly. Return its errors, one sentence each."""
        if self._process.poll() is None:
            self._stopping = True
            self._process.terminate()
            for _ in range(2):  # a second SIGTERM disables torque at once
                try:
                    self._process.wait(END_S)
                    break
                except subprocess.TimeoutExpired:
                    self._process.terminate()
            else:
                self._process.kill()
                self._process.wait()
        found = self._sentences()
        self._stdout.close()
        self._stderr.close()
        return found

    def _sentences(self) -> tuple[str, ...]:
        """Return the errors that the ended process printed, one sentence each; empty if it succeeded."""
        code = self._process.returncode
        if code == 0 or (code == 130 and self._stopping):
            return ()
        self._stderr.seek(0)
        self._stdout.seek(0)
        errors = self._stderr.read().decode(errors="replace").split("\n")
        verdict = self._stdout.read().decode(errors="replace").split("\n")
        # The first indented line of the summary has the reason for a bad exit code.
        lines = (*errors, *[each for each in verdict if each.startswith("  ")][:1])
        what = tuple(dict.fromkeys(line.strip().removeprefix("dxlrun: ") for line in lines if line.strip()))
        return what or (f"the run ended with exit code {code}",)


def _parent_of_listener(path: Path) -> int:
    """Return the ID of the parent of the process that listens at a socket; 0 if unknown."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        with suppress(OSError, ValueError, IndexError):
            probe.connect(str(path))
            pid, _, _ = _CREDENTIALS.unpack(
                probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
            )
            # The name of the program, in parentheses, may contain spaces (proc(5)).
            return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    return 0
