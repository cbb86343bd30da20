"""A run that is started for an experiment, as a child process, and ends with it."""

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
import ctypes, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG: it ends in order with the experiment
from dxlrun.cli import main
sys.exit(main())
"""
_CREDENTIALS = struct.Struct("=3i")
START_S = 60.0
"""How long a robot may take until it runs: start-up of its servos, compilation, loading of plug-ins."""
END_S = 30.0
_POLL_S = 0.05


class OwnRun:
    """A run in a process of its own; its output is kept, and shown only of one that fails.

    It has a session of its own, so that Ctrl-C reaches the experiment alone; it ends in order when the
    experiment's process is gone.
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
        """Wait until it runs, and return it as its client; None where `abort` returned a sentence before.

        Raises ProcessFault when it ended, or takes longer than START_S.
        """
        until = time.monotonic() + START_S
        while abort() is None:
            if self._process.poll() is not None:
                raise ProcessFault("\n".join(self._sentences()) or "the run ended before it began")
            for name, path in sockets().items():
                if _parent_of_listener(path) == self._process.pid:
                    robot = RemoteRobot(name, SocketLink(path, "experiment"))
                    if robot.info()["cycles"]:
                        return robot
                    robot.close()
            if time.monotonic() > until:
                raise ProcessFault(f"the run did not begin within {START_S:g} s")
            time.sleep(_POLL_S)
        return None

    def end(self) -> tuple[str, ...]:
        """End it in order; return what went wrong with it, one sentence each."""
        if self._process.poll() is None:
            self._stopping = True
            self._process.terminate()
            for _ in range(2):  # the second request cuts torque at once
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
        """Return why it failed; nothing where it did not."""
        code = self._process.returncode
        if code == 0 or (code == 130 and self._stopping):
            return ()
        self._stderr.seek(0)
        self._stdout.seek(0)
        errors = self._stderr.read().decode(errors="replace").split("\n")
        verdict = self._stdout.read().decode(errors="replace").split("\n")
        # of the verdict, whose sentences are indented, the first says why it is not good
        lines = (*errors, *[each for each in verdict if each.startswith("  ")][:1])
        what = tuple(dict.fromkeys(line.strip().removeprefix("dxlrun: ") for line in lines if line.strip()))
        return what or (f"the run ended with exit code {code}",)


def _parent_of_listener(path: Path) -> int:
    """Return the parent process of the one that listens at a socket; 0: it is not known."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        with suppress(OSError, ValueError, IndexError):
            probe.connect(str(path))
            pid, _, _ = _CREDENTIALS.unpack(
                probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
            )
            # proc(5): the name of the program, in brackets, may have spaces
            return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    return 0
