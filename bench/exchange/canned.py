"""The starter's side of the canned responder."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec

from dxlrun.errors import ProcessFault
from dxlsim.simulation_plan import BusConfig
from exchange.hosts import Host

_RESPONDER = Path(__file__).with_name("responder.py")
_MOST_REHEARSALS = 500
_ALIKE = 3
"""Two goals in turn are written, so of two alike there would be only one of each."""
_END_TIMEOUT_S = 10.0

Steps = tuple[tuple[int, int], ...]
"""Of one exchange: bytes that go to the servos, bytes that come back."""


class _Answer(msgspec.Struct):
    """A line of the responder."""

    ports: tuple[str, ...] = ()
    steps: Steps = ()


class CannedResponder:
    """The process that answers; one line a host."""

    def __init__(self, buses: Sequence[BusConfig], core: int) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(_RESPONDER), "--core", str(core)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # a terminal's Ctrl-C is for its starter, which ends it
        )
        self.ports = self._ask(msgspec.json.encode(tuple(buses))).ports
        """The devices, one a bus."""

    def rehearse(self, port: int, host: Host, *, first: bool) -> Steps:
        """Let a host exchange with servos until it does so alike, then answer alike for ever.

        Returns the steps. Raises ProcessFault when its exchanges never become alike.
        """
        self._do(port, "rehearse")
        if first:
            host.start()
        host.recover()  # a servo that just got torque has no goals yet
        before: Steps = ()
        alike = 0
        for _ in range(_MOST_REHEARSALS):
            self._do(port, "learn")
            good = host.exchange()
            steps = self._do(port, "play")
            alike = alike + 1 if good and steps and steps == before else 0
            if alike == _ALIKE:
                return steps
            before = steps if good else ()
            if not good:
                self._do(port, "rehearse")
                host.recover()
        raise ProcessFault(
            "the exchanges were never alike while the servos answered; nothing can be measured"
        )

    def close(self) -> None:
        """End the process: it ends with its input."""
        try:
            self._process.communicate(timeout=_END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()

    def _do(self, port: int, what: str) -> Steps:
        return self._ask(json.dumps({"do": what, "port": port}).encode()).steps

    def _ask(self, line: bytes) -> _Answer:
        assert self._process.stdin is not None  # both are pipes
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(line + b"\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = b""
        if not answer:
            raise ProcessFault("the canned responder ended; its output has the reason")
        return msgspec.json.decode(answer, type=_Answer)
