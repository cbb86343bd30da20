"""Measurement of `dxlrun latency`: blocks of wake-ups, each in a process of its own.

Settings that the operating system refuses are detected before the first block: the process of each condition
is started once without wake-ups, and reports the granted settings.
"""

from __future__ import annotations

import os
import select
import shlex
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from dxlrun import InputError, ProcessFault
from dxlrun.tooling import realtime
from dxlrun.tooling.realtime import Grant, load, start_module
from dxlrun_analysis.latency.conditions import Condition, Settings, order
from dxlrun_analysis.latency.statistics import Block
from dxlrun_lab.latency.buffer import Buffer, BufferOffset, create_file, read_file
from dxlrun_lab.latency.wake_ups import WakeUpJob
from dxlrun_lab.stress import Stress

_SOURCE = Path(__file__).with_name("yardstick.c")
_FLAGS = ("-std=c11", "-O2", "-Wall", "-Wextra")
_LOOK_S = 0.2
"""Period in which this (front) process reads the progress of the measuring process, s"""
_STANDSTILL_S = 30.0
"""Time without progress after which a process is given up, s; two periods are added"""
_STOP_S = 2.0

Progress = Callable[[str, float], None]
"""Function that shows the progress: name of the present block, and fraction of all wake-ups so far"""


@dataclass(slots=True)
class LatencyMeasurement:
    """Blocks that were measured so far, which remain valid after an interrupt or a failure"""

    blocks: list[Block] = field(default_factory=list)
    interrupted: bool = False
    failure: str = ""
    """Failure of a measuring process, one sentence; empty on success"""
    remarks: list[str] = field(default_factory=list)
    """Remarks for the report, one sentence each: memory was not locked, the load ended early"""


@contextmanager
def compiled_yardstick(settings: Settings) -> Iterator[str]:
    """Compile the C program yardstick.c if a condition needs it, and yield its path, or an empty text.

    The program is in an anonymous file, which disappears with this process and can be executed even if /tmp
    is mounted noexec.

    Raises:
        InputError: The compiler is missing, or it fails.
    """
    if not any(condition.in_c for condition in settings.conditions):
        yield ""
        return
    compiler = shlex.split(os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc") or "")
    if not compiler:
        raise InputError(
            "c of --compare needs the C compiler cc; install a compiler (Debian, Ubuntu: `sudo apt install "
            "gcc`), or omit c"
        )
    with tempfile.TemporaryDirectory(prefix="dxlrun-latency-") as folder:
        target = Path(folder) / "yardstick"
        try:
            built = subprocess.run(
                [*compiler, *_FLAGS, "-o", str(target), str(_SOURCE)],
                capture_output=True,
                text=True,
                check=False,
            )
        except OSError as error:
            raise InputError(
                f"c of --compare was not compiled, {compiler[0]} did not run: {error.strerror or error}"
            ) from error
        if built.returncode:
            first = (built.stderr.strip().splitlines() or ["no reason given"])[0]
            raise InputError(f"c of --compare was not compiled: {first}")
        program = create_file("yardstick", target.read_bytes())
    try:
        yield f"/proc/{os.getpid()}/fd/{program}"
    finally:
        os.close(program)


def require_grants(settings: Settings, yardstick: str) -> tuple[str, ...]:
    """Check that the settings of each condition are granted, by a process of each without wake-ups.

    Returns:
        A remark if memory was not locked, which does not prevent the measurement.

    Raises:
        InputError: The scheduling policy or the cores were not granted.
    """
    for condition in settings.conditions:
        with _Process(settings, condition, 0, yardstick) as process:
            process.wait_for_exit()
            for grant in process.grants():
                if not grant.granted and grant.request in {"scheduler", "cores"}:
                    raise InputError(f"nothing was measured: {grant.full_sentence}")
    return () if realtime.may_lock() else (realtime.lock_memory().full_sentence,)


def keep_cores_awake(settings: Settings) -> None:
    """With --idle-latency, keep cores out of deep idle states until this process exits.

    Raises InputError if the operating system refuses that.
    """
    if settings.idle_latency:
        grant = realtime.keep_awake()
        if not grant.granted:
            raise InputError(f"nothing was measured: {grant.full_sentence}")


def measure_blocks(
    settings: Settings, yardstick: str, stress: Stress, progress: Progress, measured: LatencyMeasurement
) -> None:
    """Measure all blocks, alternating the conditions, and append them to `measured`.

    An interrupt or a failure ends the measurement and is noted there. `yardstick` is the C program's path.
    """
    total = settings.iterations * len(settings.conditions)
    done = 0
    try:
        for number in range(settings.blocks):
            for condition in order(settings.conditions, number):
                iterations = settings.share(number)
                name = f"{condition.name} {number + 1}/{settings.blocks}"
                before = done

                def show_progress(here: int, worst_us: float, name: str = name, before: int = before) -> None:
                    progress(f"{name}, worst {worst_us:.0f} us", (before + here) / total)

                with _Process(settings, condition, iterations, yardstick) as process:
                    try:
                        process.watch_progress(show_progress)
                        process.wait_for_exit()
                    finally:
                        measured.blocks.append(process.block(number))
                done += iterations
    except KeyboardInterrupt:
        measured.interrupted = True
    except ProcessFault as fault:
        measured.failure = str(fault)
    measured.remarks += stress.ended()


class _Process:
    """Process that measures one block of a condition, and the shared memory with its wake-ups"""

    def __init__(self, settings: Settings, condition: Condition, iterations: int, yardstick: str) -> None:
        self._condition = condition
        self._period_ns = settings.period_ns
        self._buffer = Buffer.create(iterations)
        self._grants, self._errors = create_file("grants"), create_file("stderr")
        job = WakeUpJob(
            parent=os.getpid(),
            scheduler=settings.scheduler(condition, realtime.may_lock()),
            period_ns=settings.period_ns,
            iterations=iterations,
            buffer=self._buffer.descriptor,
            grants=self._grants,
            yardstick=yardstick if condition.in_c else "",
        )
        self._process = start_module(
            "dxlrun_lab.latency.wake_ups",
            [msgspec.json.encode(job).decode()],
            (self._buffer.descriptor, self._grants),
            self._errors,
        )

    def __enter__(self) -> _Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._buffer.close()
        os.close(self._grants)
        os.close(self._errors)

    def watch_progress(self, show: Callable[[int, float], None]) -> None:
        """Call `show` with number of wake-ups and largest lateness (us) so far, until the process ends.

        On an interrupt, the process is requested to end, so that its last wake-up is complete.
        KeyboardInterrupt is then raised again.

        Raises:
            ProcessFault: The process made no progress for too long.
        """
        words, seen, worst_ns, idle_s = self._buffer.words, 0, 0, 0.0
        limit_s = _STANDSTILL_S + 2 * self._period_ns / 1e9
        try:
            while not self._ended(_LOOK_S):
                done = load(words, BufferOffset.DONE)
                idle_s = 0.0 if done > seen else idle_s + _LOOK_S
                if idle_s > limit_s:
                    raise ProcessFault(f"{self._condition.label} measured nothing for {idle_s:.0f} s")
                worst_ns = max(worst_ns, self._buffer.worst_ns(seen, done))
                seen = done
                show(done, worst_ns / 1e3)
        except KeyboardInterrupt:
            words[BufferOffset.STOP] = 1
            self._ended(_STOP_S)
            raise

    def _ended(self, timeout_s: float) -> bool:
        pidfd = os.pidfd_open(self._process.pid)
        try:
            ready, _, _ = select.select([pidfd], [], [], timeout_s)
        finally:
            os.close(pidfd)
        return bool(ready)

    def wait_for_exit(self) -> None:
        """Wait for the process to exit. Raises ProcessFault on a timeout or a bad exit code."""
        try:
            code = self._process.wait(_STANDSTILL_S)
        except subprocess.TimeoutExpired:
            raise ProcessFault(f"the measuring process of {self._condition.label} did not exit") from None
        if code:
            last = (read_file(self._errors).decode(errors="replace").strip().splitlines() or [""])[-1]
            how = signal.Signals(-code).name if code < 0 else last or f"exit code {code}"
            raise ProcessFault(f"the measuring process of {self._condition.label} exited ({how})")

    def grants(self) -> tuple[Grant, ...]:
        """Return for each requested setting whether the operating system granted it."""
        return msgspec.json.decode(read_file(self._grants), type=tuple[Grant, ...])

    def block(self, number: int) -> Block:
        """Return the wake-ups so far, as block `number` of the condition."""
        words = self._buffer.words
        return Block(
            self._condition.name,
            number,
            self._buffer.wake_ups(),
            words[BufferOffset.CPU_NS],
            words[BufferOffset.WALL_NS],
            words[BufferOffset.MARGIN_NS],
        )
