"""The starter's side of the canned responder."""

from __future__ import annotations

import os
from collections.abc import Sequence

import msgspec

from dxlrun.bench.hosts import Host
from dxlrun.errors import ProcessFault
from dxlrun.run.channels import process
from dxlrun.run.channels.child import Child
from dxlrun.simulation import BusConfig
from dxlrun.simulation.configuration import encode_config

_MOST_REHEARSALS = 500
_ALIKE = 3
"""Two goals in turn are written, so of two alike there would be only one of each."""
_TIMEOUT_S = 5.0

Steps = tuple[tuple[int, int], ...]
"""Of one exchange: bytes that go to the servos, bytes that come back."""


class CannedResponder:
    """The process that answers; one line a host."""

    def __init__(self, buses: Sequence[BusConfig], core: int) -> None:
        self._errors = process.memory_file("dxlrun-bench-stderr")
        config = process.memory_file("dxlrun-bench", encode_config(buses))
        try:
            self._child = Child(
                "canned responder",
                "dxlrun.bench.responder",
                ["--config-fd", str(config), "--core", str(core)],
                [config],
                self._errors,
            )
        finally:
            os.close(config)
        self.ports = msgspec.convert(self._child.ready()["ports"], type=tuple[str, ...])
        """The devices, one a bus."""

    def rehearse(self, port: int, host: Host, *, first: bool) -> Steps:
        """Let a host exchange with servos until it does so alike, then answer alike for ever.

        Returns the steps. Raises ProcessFault when its exchanges never become alike.
        """
        self._do(port, "rehearse")
        host.start() if first else host.mend()
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
                host.mend()
        raise ProcessFault(
            "the exchanges were never alike while the servos answered; nothing can be measured"
        )

    def close(self) -> None:
        """End the process."""
        self._child.end()
        os.close(self._errors)

    def _do(self, port: int, what: str) -> Steps:
        self._child.line.send({"do": what, "port": port})
        answer = self._child.message(_TIMEOUT_S)
        if answer is None:
            told = process.whole(self._errors).decode(errors="replace").strip()
            raise ProcessFault(f"the canned responder ended: {told.splitlines()[-1] if told else 'no word'}")
        return msgspec.convert(answer["steps"], type=Steps)
