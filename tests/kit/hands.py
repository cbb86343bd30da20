"""Hands: scripts that answer dialogues, and simulated servos that they connect and turn."""

import os
import re
import select
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self, cast

from tests.kit import awaited
from tests.kit.rigs import VirtualLine

from dxlrun import running
from dxlrun.dynamixel.tools.tool_port import TunablePort
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.simulation_plan import ServoConfig

LOOK_NS = 20_000_000


class HandLine(VirtualLine):
    """A line of simulated servos that a hand connects, disconnects and turns."""

    def __init__(self, *servos: ServoConfig, protocol: float = 2.0, rate: int = 57_600) -> None:
        super().__init__(*servos, protocol=protocol, rate=rate)
        self._faults = FaultScript([])
        self._faults.attach([self.bus])

    def open(self, path: str) -> TunablePort:
        self.name = path
        return cast("TunablePort", self)

    def wait(self, duration_ns: int) -> None:
        """Let time pass."""
        self.clock.wait_until(self.clock.now_ns() + duration_ns)
        self.bus.advance_to(self.clock.now_ns())

    def connect(self, *indices: int) -> None:
        """Connect these servos, by their order, and no others."""
        for index, servo in enumerate(self.bus.servos):
            servo.silence(index not in indices)

    def turn(self, servo_id: int, degrees: float, look: Callable[[], object], seconds: float = 1.0) -> None:
        """Turn a shaft by the fault of that kind, and look meanwhile."""
        if abs(degrees) < 0.01:
            return
        now_ns = self.clock.now_ns()
        self.bus.advance_to(now_ns)
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

    def print_lines(self, *lines: str) -> None:
        self.said += lines

    def ask_question(self, question: str) -> str:
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


CODE = "import sys; from dxlrun.cli import main; sys.exit(main())"
ENDING_S = 15.0


class LiveRobot:
    """A robot that runs on simulated servos in real time, which a hand turns; a context manager."""

    def __init__(self, directory: Path, robot: Path, *, runs: bool = True) -> None:
        self.link, self._said = directory / "line", directory / "said"
        self._directory, self._robot = directory, robot
        command = [sys.executable, "-P", "-c", CODE, "sim", str(robot), "--link", str(self.link)]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "text": True, "cwd": directory}
        self._servos = subprocess.Popen(command, **pipes)
        self._run: subprocess.Popen[bytes] | None = None
        try:
            self.until(self.link.exists)
            if runs:
                self.start()
        except BaseException:
            self.__exit__()
            raise

    def start(self) -> None:
        """Run the robot."""
        words = [sys.executable, "-P", "-c", CODE, str(self._robot), f"port:={self.link}", "--no-record"]
        with self._said.open("wb") as said:
            self._run = subprocess.Popen(words, cwd=self._directory, stdout=said, stderr=said)
        self.until(lambda: bool(running()))

    def restart(self) -> None:
        """Run the robot again where it has ended: a loop without a processor for 0.1 s is killed."""
        if self._run is not None and self._run.poll() is not None:
            self.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._run is not None and self._run.poll() is not None:
            print(self._said.read_text())  # pytest shows beside a failed test why the robot ended
        for process in filter(None, (self._run, self._servos)):
            process.terminate()
            try:
                process.communicate(timeout=ENDING_S)
            except subprocess.TimeoutExpired:  # on a busy machine; how runs end is tested elsewhere
                process.kill()
                process.communicate()

    def turn(self, look: Callable[[], object], seconds: float, **turns: float) -> None:
        """Turn servos by degrees, by ID (`id5=20`), and look until they are there."""
        for name, degrees in turns.items():
            if not degrees:
                continue
            self.inject(f"turn servo={name[2:]} by={degrees:.3f}deg for={seconds:g}s")
        tick, end = threading.Event(), time.monotonic() + seconds + 0.3
        while time.monotonic() < end:
            look()
            tick.wait(0.02)

    def inject(self, fault: str) -> None:
        assert self._servos.stdin is not None
        self._servos.stdin.write(f"{fault}\n")
        self._servos.stdin.flush()

    def until(self, done: Callable[[], bool]) -> None:
        """Wait for something, while servos and robot run."""

        def said() -> str:
            return self._said.read_text() if self._said.exists() else ""

        def live() -> None:
            assert self._servos.poll() is None, said()
            assert self._run is None or self._run.poll() is None, said()

        awaited.until(done, said, check=live)


def plain(shown: str) -> str:
    """Return what a terminal showed without its escape sequences."""
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)


class Screen:
    """A command at a terminal; a context manager, which ends it."""

    def __init__(self, directory: Path, *words: str, columns: int = 80, **variables: str) -> None:
        self.terminal, slave = os.openpty()
        termios.tcsetwinsize(slave, (24, columns))
        command = [sys.executable, "-P", "-c", CODE, *words]
        environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
        streams = dict.fromkeys(("stdin", "stdout", "stderr"), slave)
        # a session of its own, with this terminal: so Ctrl-C reaches it
        take = "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); "
        take += "os.execv(sys.argv[1], sys.argv[1:])"
        self.process = subprocess.Popen(
            [sys.executable, "-c", take, *command],
            cwd=directory,
            env=environment | variables,
            start_new_session=True,
            **streams,
        )
        os.close(slave)
        self.text = self.shown = ""
        """What was not waited for yet, and all that was shown."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.terminal)

    def sees(self, words: str) -> None:
        """Wait until the terminal shows words behind those that were waited for before."""

        def seen() -> bool:
            # The terminal's end is a failure, unless it showed the words last
            return words in self.text or not (self._read() or words in self.text)

        awaited.until(seen, lambda: self.text, pause_s=0.0)
        assert words in self.text, self.text
        self.text = self.text.partition(words)[2]

    def matches(self, pattern: str) -> None:
        """Wait until all that was shown, without colours and moves of the cursor, has a pattern."""
        while not re.search(pattern, plain(self.shown)):
            assert self._read(), self.shown

    def types(self, text: str) -> None:
        os.write(self.terminal, text.encode())

    def kill(self) -> None:
        """End it as no program can prevent."""
        self.process.kill()

    def echoes(self) -> bool:
        """Return whether the terminal shows what is typed, line by line, as it did before."""
        modes = termios.tcgetattr(self.terminal)[3]
        return modes & (termios.ECHO | termios.ICANON) == termios.ECHO | termios.ICANON

    def ended(self) -> int:
        """Return the exit code; `text` has all that was shown until then."""
        while self._read():
            pass
        return self.process.wait(awaited.DEADLINE_S)

    def _read(self) -> bool:
        if not select.select([self.terminal], [], [], awaited.DEADLINE_S)[0]:
            return False
        try:
            data = os.read(self.terminal, 4096)
        except OSError:  # its other end is closed
            return False
        text = data.decode(errors="replace")
        self.text, self.shown = self.text + text, self.shown + text
        return bool(data)
