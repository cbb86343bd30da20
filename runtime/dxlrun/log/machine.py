"""Machine load: samples each core's load and frequency, temperature, and the loop process once a second.

The recorder's process samples them from /proc and /sys (proc(5); cpufreq and thermal of the kernel's
documentation). Values that a system does not provide are NaN, never an error: virtual machines have no
frequency, some kernels no schedstat.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.log.schemas import MACHINE
from dxlrun.messages.cdr import Codec
from dxlrun.plan.machine_load import LoadSample

_SHARES = ("user", "nice", "system", "idle", "iowait", "irq", "softirq", "steal")
"""Columns of a core in /proc/stat, times in ticks; `user` already contains guests."""
_LAST_CORE = 38
"""Index of the field `processor` (last used core) in /proc/PID/stat, counted from 0."""
_UNREADABLE = (OSError, ValueError, IndexError, KeyError)
Floats = NDArray[np.float64]


class _Counters(msgspec.Struct, frozen=True, eq=False):
    """One reading of counters that only grow: CPU times per core, memory pressure, the loop process."""

    t_ns: int
    ticks: Floats
    """CPU time by state, ticks, shape (cores, columns of /proc/stat)."""
    pressure_s: float
    """Total time during which some process waited for memory, s."""
    process: dict[str, float]


class MachineSampler:
    """Samples the load of this machine and of one process, by its PID.

    `root` replaces the file system's root in tests.
    """

    def __init__(self, pid: int, root: Path = Path("/")) -> None:
        self._root = root
        self._process = root / "proc" / str(pid)
        cores = sorted(
            (int(path.parent.parent.name[3:]), path)
            for path in root.glob("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_cur_freq")
        )
        self._frequencies = dict(cores)
        self._temperatures = [
            *root.glob("sys/class/thermal/thermal_zone*/temp"),
            *root.glob("sys/class/hwmon/hwmon*/temp*_input"),
        ]
        self._before: _Counters | None = None
        self._codec = Codec(MACHINE)

    def sample_machine(self, t_ns: int) -> bytes | None:
        """Return an encoded message of /machine about the time since the last call; None at the first call.

        `t_ns`: time of the run's clock.
        """
        now, before = _Counters(t_ns, self._ticks(), self._pressure_s(), self._of_process()), self._before
        self._before = now
        if before is None:
            return None
        cores = max(len(now.ticks), len(self._frequencies))
        shares = _shares(now.ticks, before.ticks, cores)
        process = {
            name: now.process.get(name, math.nan) - before.process.get(name, math.nan) for name in _PROCESS
        }
        seconds = (t_ns - before.t_ns) / 1e9
        return self._codec.pack(
            t_ns,
            t_ns - before.t_ns,
            self._core(),
            *(np.ascontiguousarray(row) for row in shares),
            np.array([self._frequency(core) for core in range(cores)], np.float64),
            max(_readable(self._temperatures), default=math.nan) / 1e3,
            (now.pressure_s - before.pressure_s) / seconds if seconds > 0 else math.nan,
            *(process[name] for name in _PROCESS),
        )

    def _ticks(self) -> Floats:
        try:
            rows = [
                line.split()
                for line in (self._root / "proc/stat").read_text().splitlines()
                if line.startswith("cpu") and line[3:4].isdigit()
            ]
            ticks = np.full((max((int(row[0][3:]) for row in rows), default=-1) + 1, len(_SHARES)), np.nan)
            for row in rows:
                ticks[int(row[0][3:])] = [float(value) for value in row[1 : len(_SHARES) + 1]]
        except _UNREADABLE:
            return np.zeros((0, len(_SHARES)))
        return ticks

    def _pressure_s(self) -> float:
        with suppress(*_UNREADABLE):
            text = (self._root / "proc/pressure/memory").read_text()
            return float(text.split("total=", 1)[1].split()[0]) / 1e6
        return math.nan

    def _of_process(self) -> dict[str, float]:
        """Return the watched process's counters, by field name of the message, without unreadable ones."""
        found: dict[str, float] = {}
        with suppress(*_UNREADABLE):
            running, waiting, _ = (float(word) for word in self._text("schedstat").split())
            # A zero means that the kernel does not count.
            if running:
                found |= {"loop_running": running / 1e9, "loop_waiting": waiting / 1e9}
        with suppress(*_UNREADABLE):
            lines = (line.partition(":") for line in self._text("status").splitlines())
            status = {name: value.strip() for name, _, value in lines}
            found["loop_voluntary"] = float(status["voluntary_ctxt_switches"])
            found["loop_involuntary"] = float(status["nonvoluntary_ctxt_switches"])
        with suppress(*_UNREADABLE):
            fields = self._stat()
            found |= {"loop_minor_faults": float(fields[9]), "loop_major_faults": float(fields[11])}
        return found

    def _core(self) -> int:
        with suppress(*_UNREADABLE):
            return int(self._stat()[_LAST_CORE])
        return -1

    def _stat(self) -> list[str]:
        """Return the fields of /proc/PID/stat; the first two (PID, program name) are empty texts."""
        text = self._text("stat")
        return ["", "", *text[text.rindex(")") + 1 :].split()]

    def _text(self, name: str) -> str:
        return (self._process / name).read_text()

    def _frequency(self, core: int) -> float:
        """Return the present frequency of a core, Hz; NaN if it is not known."""
        path = self._frequencies.get(core)
        return max(_readable([path] if path else []), default=math.nan) * 1e3


_PROCESS = (
    "loop_running",
    "loop_waiting",
    "loop_voluntary",
    "loop_involuntary",
    "loop_minor_faults",
    "loop_major_faults",
)


def _shares(now: Floats, before: Floats, cores: int) -> Floats:
    """Return the shares of time per core between two readings, shape (6, cores).

    Rows are user, system, irq, softirq, steal and idle; a share is 0 to 1, NaN if not known.
    """
    spent = np.full((cores, len(_SHARES)), np.nan)
    both = min(len(now), len(before))
    spent[:both] = now[:both] - before[:both]
    total = spent.sum(axis=1, keepdims=True)
    spent = np.divide(spent, total, out=np.full_like(spent, np.nan), where=total > 0)
    user, nice, system, idle, iowait, irq, softirq, steal = spent.T
    return np.array([user + nice, system, irq, softirq, steal, idle + iowait])


def _readable(paths: Iterable[Path]) -> Iterable[float]:
    for path in paths:
        with suppress(*_UNREADABLE):
            yield float(path.read_text())


def load_sample(message: Mapping[str, object]) -> LoadSample:
    """Extract idle, steal and the loop's waiting time from a decoded message of /machine."""
    end_ns, interval_ns = cast("int", message["t_ns"]), cast("int", message["interval_ns"])
    idle, steal = (cast("Floats", message[name]) for name in ("idle", "steal"))
    return LoadSample(
        end_ns - interval_ns,
        end_ns,
        float(idle.max()) if len(idle) else math.nan,
        float(np.nan_to_num(steal).max(initial=0.0)),
        cast("float", message["loop_waiting"]) * 1e9 / interval_ns if interval_ns > 0 else math.nan,
    )
