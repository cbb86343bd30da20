"""What the machine has of late wake-ups, and whether it was too busy for the run; by samples of /machine."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from numpy.typing import NDArray

from dxlrun.log.reader import Log
from dxlrun.log.schemas import MACHINE_TOPIC
from dxlrun.messages.cdr import Value

STEAL = "steal by the host"
OTHERS = "other processes on its core"
INTERRUPTS = "interrupts on its core"
TAKERS = (STEAL, OTHERS, INTERRUPTS)
THROTTLED_SHARE = 0.6
"""Of the highest frequency that was seen: a core that is slower while the loop is late is throttled [i]."""
_WAITING_SHARE = 0.001
_INTERRUPTS_SHARE = 0.05
"""Shares of a second that a well machine takes, too [i]: /proc/stat counts in steps of 10 ms."""
HOT = 80.0  # deg C from which processors are throttled [i]
_IDLE_SHARE = 0.05  # Of a second; less is no idle core: /proc/stat counts in steps of 10 ms
_STOLEN_SHARE = 0.05
_KEPT_WAITING_SHARE = 0.01  # Of a second; a loop at 1 kHz misses ten cycles in it
_PART_NS = 500_000_000  # A shorter sample, as at the end, is not counted
_FEWEST_BUSY_S = 3
_BUSY_PART = 0.1
Numbers = NDArray[np.int64]


@dataclass(slots=True)
class MachineLoad:
    """In how many of the sampled seconds, all of them after the first deadline, the machine was too busy."""

    seconds: int = 0
    no_idle_core: int = 0
    stolen: int = 0  # The host kept more than 5 % of a core back
    waited: int = 0  # The loop was runnable without a core for more than 10 ms
    busy: int = 0  # Any of these

    @property
    def share(self) -> float:
        """Share of the run in which it was too busy; 0 for less than 3 s or a tenth of the run."""
        enough = self.busy >= max(_FEWEST_BUSY_S, _BUSY_PART * self.seconds)
        return self.busy / self.seconds if enough else 0.0

    @property
    def text(self) -> str:
        """What was seen, for a sentence."""
        seen = (
            (self.no_idle_core, "no core was idle in"),
            (self.waited, "the loop waited for a core in"),
            (self.stolen, "the host kept cores back in"),
        )
        return ", ".join(f"{text} {count} of {self.seconds} s" for count, text in seen if count)


@dataclass(frozen=True, slots=True)
class MachineSample:
    """One sample, as far as it explains what the loop did not get."""

    begin_ns: int
    end_ns: int
    taken_ns: tuple[int, ...]  # Beyond what a well machine takes, by TAKERS


@dataclass(slots=True)
class MachineHistory:
    """Reads the samples."""

    _fastest: float = 0.0
    slow: int = 0  # Samples with a core that was hot and far below its highest frequency
    load: MachineLoad = field(default_factory=MachineLoad)

    def new(self, log: Log, begin_ns: int | None) -> list[MachineSample]:
        """Return the samples of a slice. Raises LogError when one cannot be read.

        `begin_ns`: the first deadline; a machine that is busy before it starts the run.
        """
        if MACHINE_TOPIC not in log.topics:
            return []
        return [self._sample(message, begin_ns) for message in log.messages(MACHINE_TOPIC)]

    def _sample(self, message: Mapping[str, Value], run_begin_ns: int | None) -> MachineSample:
        end_ns, interval_ns = cast("int", message["t_ns"]), cast("int", message["interval_ns"])
        if run_begin_ns is not None and run_begin_ns <= end_ns - interval_ns and interval_ns > _PART_NS:
            self._count(message, interval_ns)
        core = cast("int", message["loop_core"])
        steal, interrupts, softirq = (_of_core(message[name], core) for name in ("steal", "irq", "softirq"))
        waiting = _number(message["loop_waiting"]) * 1e9
        interrupts = (interrupts + softirq) * interval_ns
        taken = (
            steal * interval_ns,
            waiting - _WAITING_SHARE * interval_ns,
            interrupts - _INTERRUPTS_SHARE * interval_ns,
        )
        self.slow += self._is_slow(message)
        return MachineSample(end_ns - interval_ns, end_ns, tuple(max(0, round(one)) for one in taken))

    def _count(self, message: Mapping[str, Value], interval_ns: int) -> None:
        """Count a second, and whether the machine was too busy in it."""
        idle, steal = (cast("NDArray[np.float64]", message[name]) for name in ("idle", "steal"))
        found = (
            bool(len(idle)) and bool((idle < _IDLE_SHARE).all()),
            bool((steal > _STOLEN_SHARE).any()),
            _number(message["loop_waiting"]) * 1e9 > _KEPT_WAITING_SHARE * interval_ns,
        )
        self.load.seconds += 1
        self.load.no_idle_core += found[0]
        self.load.stolen += found[1]
        self.load.waited += found[2]
        self.load.busy += any(found)

    def _is_slow(self, message: Mapping[str, Value]) -> bool:
        frequency = cast("NDArray[np.float64]", message["frequency"])
        known = frequency[np.isfinite(frequency)]
        if not len(known):
            return False
        self._fastest = max(self._fastest, float(known.max()))
        return float(known.max()) < THROTTLED_SHARE * self._fastest and _number(message["temperature"]) >= HOT


def _of_core(values: Value, core: int) -> float:
    """Return the share of one core, or where that is not known the greatest of all; 0: not known."""
    shares = np.nan_to_num(cast("NDArray[np.float64]", values))
    if 0 <= core < len(shares):
        return float(shares[core])
    return float(shares.max(initial=0.0))


def _number(value: Value) -> float:
    number = cast("float", value)
    return number if math.isfinite(number) else 0.0
