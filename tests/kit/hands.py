"""Hands: a scripted person who answers dialogues, and servos on virtual time that it connects and turns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Self, cast

from tests.kit.rigs import VirtualLine

from dxlrun.dynamixel.tools.tool_line import TunablePort
from dxlrun.simulation import ServoConfig
from dxlrun.simulation.faults.fault import parse_fault
from dxlrun.simulation.faults.script import FaultScript

LOOK_NS = 20_000_000


class HandLine(VirtualLine, AbstractContextManager["HandLine"]):
    """A line of simulated servos that a hand connects, disconnects and turns."""

    def __init__(self, *servos: ServoConfig, protocol: float = 2.0, rate: int = 57_600) -> None:
        super().__init__(*servos, protocol=protocol, rate=rate)
        self._faults = FaultScript([])
        self._faults.attach([self.bus])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def open(self, path: str) -> TunablePort:
        """Be the port that a command opens."""
        self.name = path
        return cast("TunablePort", self)

    def wait(self, duration_ns: int) -> None:
        """Let time pass."""
        self.clock.wait_until(self.clock.now_ns() + duration_ns)
        self.bus.advance(self.clock.now_ns())

    def connect(self, *indices: int) -> None:
        """Connect these servos, by their order, and no others."""
        for index, servo in enumerate(self.bus.servos):
            servo.silence(index not in indices)

    def turn(self, servo_id: int, degrees: float, look: Callable[[], object], seconds: float = 1.0) -> None:
        """Turn a shaft by the fault of that kind, and look meanwhile."""
        if abs(degrees) < 0.01:
            return
        now_ns = self.clock.now_ns()
        self.bus.advance(now_ns)
        self._faults.add(parse_fault(f"turn servo={servo_id} by={degrees:.3f}deg for={seconds:g}s"), now_ns)
        end_ns = now_ns + round(seconds * 1e9) + LOOK_NS
        while self.clock.now_ns() < end_ns:
            self.wait(LOOK_NS)
            look()


class Script:
    """Answers questions in order: a text is what is typed, a function does something and returns that.

    The words beside each answer must stand in its question.
    """

    def __init__(self, *steps: tuple[str, str | Callable[..., str | None]]) -> None:
        self.steps = list(steps)
        self.said: list[str] = []

    @property
    def text(self) -> str:
        """All that was printed."""
        return "\n".join(self.said)

    def say(self, *lines: str) -> None:
        self.said += lines

    def ask(self, question: str) -> str:
        return self._answered(question)

    def ask_while(self, question: str, look: Callable[[], str]) -> str:
        return self._answered(question, look)

    def _answered(self, question: str, *look: Callable[[], str]) -> str:
        self.said.append(question)
        assert self.steps, self.text
        words, answer = self.steps.pop(0)
        assert words in question, (words, question, self.text)
        if isinstance(answer, str):
            return answer
        return answer(*look) or ""


def interrupt(*_: object) -> str:
    """Press Ctrl-C."""
    raise KeyboardInterrupt


def written(directory: Path, text: str, name: str = "arm.yaml") -> Path:
    """Write a robot file."""
    path = directory / name
    path.write_bytes(text.encode())
    return path


def steps_of(*steps: Sequence[tuple[str, str | Callable[..., str | None]]]) -> list[tuple[str, object]]:
    """Return several parts of a script as one."""
    return [one for part in steps for one in part]
