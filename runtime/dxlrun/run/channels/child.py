"""A process that this one started, and the line to it."""

from __future__ import annotations

import select
import subprocess
from collections import deque
from collections.abc import Mapping

from dxlrun.errors import PortError, ProcessFault
from dxlrun.run.channels import process

START_TIMEOUT_S = 20.0
"""A child that says nothing for so long will say nothing more; a cold import of numpy takes a second."""
END_TIMEOUT_S = 10.0
"""Also for a recorder on a slow disk, which says after each step that it goes on."""


class Child:
    """One process of the run, and the line to it."""

    def __init__(
        self, name: str, module: str, arguments: list[str], descriptors: list[int], stderr: int
    ) -> None:
        self.name = name
        self.line, theirs = process.line_pair()
        control = ["--control-fd", str(theirs.fileno())]
        self.process: subprocess.Popen[bytes] = process.start(
            module, [*arguments, *control], [*descriptors, theirs.fileno()], stderr
        )
        theirs.close()
        self.began = False
        """True after it said that it is ready."""
        self._messages: deque[Mapping[str, object]] = deque()

    def message(self, timeout_s: float) -> Mapping[str, object] | None:
        """Return what it says next; None when its end of the line is closed.

        Raises ProcessFault when it says nothing in time.
        """
        while not self._messages and not self.line.closed:
            ready, _, _ = select.select([self.line], [], [], timeout_s)
            if not ready:
                raise ProcessFault(f"the {self.name} said nothing for {timeout_s:.0f} s")
            self._messages.extend(self.line.receive())
        return self._messages.popleft() if self._messages else None

    def poll(self, timeout_s: float) -> Mapping[str, object] | None:
        """Return what it says within `timeout_s`; None when it says nothing."""
        if not self._messages:
            ready, _, _ = select.select([self.line], [], [], timeout_s)
            if ready:
                self._messages.extend(self.line.receive())
        return self._messages.popleft() if self._messages else None

    def ready(self) -> Mapping[str, object]:
        """Return its first message; raises ProcessFault when it ends before, PortError for an `error`."""
        message = self.message(START_TIMEOUT_S)
        if message is None:
            code = self.process.wait(END_TIMEOUT_S)
            raise ProcessFault(f"the {self.name} ended while it started (exit code {code}); try --debug")
        if "error" in message:
            raise PortError(str(message["error"]))
        self.began = True
        return message

    def kill(self) -> None:
        """End it at once, whatever it does."""
        self.process.kill()
        self.process.wait()
        self.line.close()

    def end(self) -> None:
        """Close the line, which asks it to end in order; kill it when it does not."""
        self.line.close()
        try:
            self.process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.kill()
