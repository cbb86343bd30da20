"""Canned responder: a process that answers counted bytes with fixed bytes, so that only the host is measured.

It has one pseudo-terminal a host. While a host rehearses, simulated servos answer it, as fast as they can and
not at the speed of a wire. What they answered during one exchange is kept: after so many bytes these bytes.
From then on nothing is parsed, computed or waited for: bytes are counted, and what was kept is written.

Its starter writes lines of JSON to its standard input. The first has the buses, one a host; the answer is
`{"ports": [device, ...]}`. Each further one is `{"do": "rehearse" | "learn" | "play", "port": number}`; the
answer is `{"steps": [[bytes that come, bytes that are answered], ...]}`, for `play` those that were kept.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import select
import sys
import time
import tty
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import msgspec

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.simulation_plan import BusConfig

Does = Literal["rehearse", "learn", "play"]
_MOST = 1 << 16


@dataclass(frozen=True, slots=True)
class Step:
    """After so many bytes of the host, these bytes."""

    count: int
    reply: bytes


class Terminal:
    """One host's line: servos while it rehearses, counted bytes afterwards."""

    def __init__(self, config: BusConfig) -> None:
        self._bus = SimulatedBus(config, Ledger(keep=False), time.monotonic_ns())
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._playing = self._learning = False
        self._steps: list[Step] = []
        self._position = self._waiting = 0

    @property
    def path(self) -> str:
        """The device that the host opens."""
        return os.ttyname(self._slave)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the host has written."""
        return self._master

    def do(self, what: Does) -> tuple[Step, ...]:
        """Let servos answer, remember what they answer from now on, or answer that from now on."""
        self.receive()  # the last bytes of the host, without a reply, may still be on their way
        if what == "play":
            if self._waiting:  # the host ends its exchange with bytes without a reply
                self._steps.append(Step(self._waiting, b""))
            self._playing, self._learning = bool(self._steps), False
        else:
            self._playing, self._learning = False, what == "learn"
            self._steps = []
        self._position = self._waiting = 0
        return tuple(self._steps)

    def receive(self) -> int:
        """Take what the host has written, and answer it; return how many bytes that were."""
        try:
            data = os.read(self._master, _MOST)
        except BlockingIOError:
            return 0
        if not self._playing:
            self._rehearse(data)
            return len(data)
        self._waiting += len(data)
        while self._waiting >= (step := self._steps[self._position]).count:
            self._waiting -= step.count
            self._position = (self._position + 1) % len(self._steps)
            if step.reply:
                os.write(self._master, step.reply)
        return len(data)

    def _rehearse(self, data: bytes) -> None:
        bus = self._bus
        bus.receive_bytes(data, max(time.monotonic_ns(), bus.now_ns))
        reply = bytearray()
        while (due_ns := bus.next_due_ns()) is not None:
            reply += bus.drain_bytes(due_ns)
        if reply:
            os.write(self._master, reply)
        if self._learning:
            self._waiting += len(data)
            if reply:
                self._steps.append(Step(self._waiting, bytes(reply)))
                self._waiting = 0


def main() -> None:
    """Answer until the standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--core", type=int, default=-1, help="core to stay on; -1: any")
    options = parser.parse_args()
    if options.core >= 0:
        with suppress(OSError):
            os.sched_setaffinity(0, {options.core})
    buses = msgspec.json.decode(sys.stdin.buffer.readline(), type=tuple[BusConfig, ...])
    terminals = [Terminal(config) for config in buses]
    _say(ports=[terminal.path for terminal in terminals])
    gc.collect()
    gc.freeze()
    _serve(terminals)


def _serve(terminals: Sequence[Terminal]) -> None:
    requests = sys.stdin.fileno()
    by_descriptor = {terminal.fileno(): terminal for terminal in terminals}
    with select.epoll() as waiting:
        for descriptor in (requests, *by_descriptor):
            waiting.register(descriptor, select.EPOLLIN)
        while True:
            for descriptor, _ in waiting.poll():
                if descriptor != requests:
                    by_descriptor[descriptor].receive()
                elif line := sys.stdin.buffer.readline():  # one at a time: the starter awaits each answer
                    request = json.loads(line)
                    steps = terminals[request["port"]].do(request["do"])
                    _say(steps=[[step.count, len(step.reply)] for step in steps])
                else:
                    return


def _say(**answer: object) -> None:
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
