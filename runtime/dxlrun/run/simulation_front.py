"""Front: the process in this terminal while simulated servos serve other programs.

It starts the process of the simulated buses, sends it the faults that a person types, passes its messages to
an audience, and stops it at SIGINT or SIGTERM.
"""

from __future__ import annotations

import os
import re
import select
import signal
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Protocol

import msgspec

from dxlrun.channels import child_processes
from dxlrun.channels.child_processes import Child, MessageChannel
from dxlrun.errors import PortError
from dxlsim.messages import SimulationJob, SimulationMessage, SimulationRequest

_LAST_LOOK_S = 1.0
"""Timeout for the last snapshot; without an answer, the simulation ends without it."""
_STOPS = frozenset((signal.SIGINT, signal.SIGTERM))
_LONGEST_LINE = 1024
_BACKGROUND_S = 0.5
_ESCAPE = re.compile(r"\x1b(?:\[[0-9;?]*[ -/]*[@-~]|O.|.)?")
"""Escape sequences of arrow and function keys, which are ignored."""


Messages = MessageChannel[SimulationMessage]


def start_simulation(job: SimulationJob, errors: int) -> Child[SimulationMessage]:
    """Start the process of simulated buses; its output goes to `errors`."""
    descriptor = child_processes.memory_file("dxlrun-simulation", msgspec.json.encode(job))
    arguments = ["--job-fd", str(descriptor)]
    inherited = [descriptor, *(one for one in (job.shafts, job.progress, *job.sockets) if one >= 0)]
    messages = msgspec.json.Decoder(SimulationMessage)
    try:
        return Child("simulated bus", "dxlrun.run.simulation_process", arguments, inherited, errors, messages)
    finally:
        os.close(descriptor)


def first_message(child: Child[SimulationMessage]) -> SimulationMessage:
    """Return the first message, which has the ports; raises PortError when the buses cannot be served."""
    message = child.ready()
    if message.error is not None:
        raise PortError(message.error)
    return message


class Audience(Protocol):
    """Output of a simulation: a terminal, or JSON."""

    # Interval of snapshots, s; None: none.
    look_every_s: float | None

    def opened(self, ports: Mapping[str, str], real_time: str) -> None:
        """Show the device of each bus, and the granted real-time properties; called once."""

    def show_message(self, message: SimulationMessage) -> None:
        """Show a message other than a snapshot; one with ports has only the changed ones."""

    def help(self) -> None:
        """Show the available faults."""

    def show_snapshot(self, look: SimulationMessage, typed: str) -> None:
        """Show the newest snapshot, and the pending input of the next line."""


class SimulationResult(msgspec.Struct, frozen=True):
    """Result of a simulation."""

    elapsed_s: float
    look: SimulationMessage
    # Errors; empty for a simulation that ran until it was stopped.
    sentences: tuple[str, ...]
    # Output of the process of the simulated buses.
    printed: str = ""


class TypedLines:
    """Non-blocking reader of typed lines; a terminal is read only in the foreground.

    The Linux kernel would stop a background job that reads its terminal.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        # True after the end of the input.
        self.ended = False
        # Pending input of the next line.
        self.pending = ""

    def fileno(self) -> int:
        """Return the file descriptor, for select."""
        return self._descriptor

    @property
    def in_foreground(self) -> bool:
        """True when a read cannot stop this process."""
        try:
            return os.tcgetpgrp(self._descriptor) == os.getpgrp()
        # Not a terminal, or not the controlling one.
        except OSError:
            return True

    def read_lines(self) -> list[str]:
        """Return the completed lines after one read, which may block."""
        try:
            data = os.read(self._descriptor, 4096)
        except OSError:
            data = b""
        if not data:
            self.ended = True
            lines, self.pending = [self.pending], ""
        else:
            lines = self._process_text(data.decode(errors="replace"))
        return [stripped for line in lines if (stripped := line.strip())]

    def _process_text(self, text: str) -> list[str]:
        lines = []
        for character in _ESCAPE.sub("", text):
            if character in "\r\n":
                lines.append(self.pending)
                self.pending = ""
            # A terminal without line editing passes these characters on.
            elif character in "\b\x7f":
                self.pending = self.pending[:-1]
            elif character == "\x15":  # Ctrl-U
                self.pending = ""
            elif character.isprintable() or character == "\t":
                self.pending = (self.pending + character)[:_LONGEST_LINE]
        return lines


def serve_simulation(job: SimulationJob, audience: Audience, typed: TypedLines | None) -> SimulationResult:
    """Serve simulated buses until SIGINT or SIGTERM; their process has exited on return.

    Raises PortError when the process refuses its configuration, ProcessFault when it does not start.
    """
    errors = child_processes.memory_file("dxlrun-stderr")
    with _stop_signals() as stop:
        began = time.monotonic()
        child = start_simulation(job, errors)
        front = _Front(child, audience, typed, stop)
        try:
            front.show_until_stopped()
        finally:
            child.end_process()
    printed = child_processes.whole(errors).decode(errors="replace")
    os.close(errors)
    sentences = _sentences(front.sentences, child.process.returncode, printed)
    return SimulationResult(time.monotonic() - began, front.newest, sentences, printed)


def _sentences(before: Sequence[str], code: int, printed: str) -> tuple[str, ...]:
    """Return the errors: a process prints the reason of an exit code other than 0."""
    last = printed.strip().splitlines()[-1:]
    if before:
        return (*before, *(f"it printed last: {line} (--debug shows all)" for line in last))
    if not code:
        return ()
    return tuple(last) or (f"the simulated bus ended with exit code {code}",)


class _Front:
    def __init__(
        self,
        child: Child[SimulationMessage],
        audience: Audience,
        typed: TypedLines | None,
        stop: socket.socket,
    ) -> None:
        self._child = child
        self._audience = audience
        self._typed = typed
        self._stop = stop
        self._ports: dict[str, str] = {}
        self.newest = SimulationMessage(servos=())
        self.sentences: list[str] = []

    def show_until_stopped(self) -> None:
        """Show the ports, then pass on messages and input until a stop signal."""
        first = first_message(self._child)
        self._ports = first.ports or {}
        self._audience.opened(self._ports, first.real_time)
        look_s = time.monotonic()
        while not self._child.channel.closed:
            if self._audience.look_every_s is not None and time.monotonic() >= look_s:
                self._child.channel.send_message(SimulationRequest(look=True))
                look_s = time.monotonic() + self._audience.look_every_s
            ready = select.select(self._sources(), [], [], self._timeout_s(look_s))[0]
            if self._stop in ready and _STOPS.intersection(self._stop.recv(64)):
                self._last_look()
                return
            if self._typed in ready and self._typed is not None:
                self._type(self._typed)
            self._listen()
        self.sentences.append("the simulated bus exited unexpectedly")

    def _sources(self) -> list[Messages | socket.socket | TypedLines]:
        sources: list[Messages | socket.socket | TypedLines] = [self._child.channel, self._stop]
        if self._typed is not None and not self._typed.ended and self._typed.in_foreground:
            sources.append(self._typed)
        return sources

    def _timeout_s(self, look_s: float) -> float | None:
        """Return the timeout of select, s; a background job polls for its return to the foreground."""
        if self._audience.look_every_s is not None:
            return max(0.0, look_s - time.monotonic())
        waiting = self._typed is not None and not self._typed.ended and not self._typed.in_foreground
        return _BACKGROUND_S if waiting else None

    def _type(self, typed: TypedLines) -> None:
        for line in typed.read_lines():
            if line in ("help", "?"):
                self._audience.help()
            else:
                self._child.channel.send_message(SimulationRequest(fault=line))
        if self._audience.look_every_s is not None:
            # Echo each typed character at once.
            self._audience.show_snapshot(self.newest, typed.pending)

    def _listen(self) -> None:
        while (message := self._child.poll_message(0)) is not None:
            if message.servos is not None:
                self.newest = message
                if self._audience.look_every_s is not None:
                    self._audience.show_snapshot(message, self._typed.pending if self._typed else "")
            elif message.ports is not None:
                moved = {bus: port for bus, port in message.ports.items() if port != self._ports.get(bus)}
                self._ports = message.ports
                if moved:
                    self._audience.show_message(SimulationMessage(moved))
            else:
                self._audience.show_message(message)

    def _last_look(self) -> None:
        """Request the last counts of the servos and show pending messages."""
        before = self.newest
        self._child.channel.send_message(SimulationRequest(look=True))
        deadline = time.monotonic() + _LAST_LOOK_S
        while self.newest is before and not self._child.channel.closed:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([self._child.channel], [], [], left)[0]:
                return
            self._listen()


@contextmanager
def _stop_signals() -> Iterator[socket.socket]:
    """Yield a socket that receives the numbers of signals; SIGINT and SIGTERM have no other effect."""
    wake, signalled = socket.socketpair()
    signalled.setblocking(False)
    before = {number: signal.signal(number, lambda *_: None) for number in _STOPS}
    descriptor = signal.set_wakeup_fd(signalled.fileno(), warn_on_full_buffer=False)
    try:
        yield wake
    finally:
        signal.set_wakeup_fd(descriptor)
        for number, handler in before.items():
            signal.signal(number, handler)
        wake.close()
        signalled.close()
