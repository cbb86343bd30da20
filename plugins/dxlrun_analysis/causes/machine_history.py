"""Time that the machine withheld from the loop, from the samples on topic /machine."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from numpy.typing import NDArray

from dxlrun import Log
from dxlrun.tooling.records import LoadMeter, LoadSample, MachineLoad, load_sample
from dxlrun.tooling.topics import LogTopic

STEAL = "host of the virtual machine"
OTHERS = "other processes on its core"
INTERRUPTS = "interrupts on its core"
TAKERS = (STEAL, OTHERS, INTERRUPTS)
THROTTLED_SHARE = 0.6
"""Share of the highest observed clock frequency below which a hot processor counts as throttled [i]."""
_WAITING_SHARE = 0.001
_INTERRUPTS_SHARE = 0.05
"""Shares of a second that waiting for a core and interrupts also take on a healthy machine [i]. /proc/stat
counts in steps of 10 ms."""
HOT = 80.0  # deg C from which processors are throttled [i]


@dataclass(frozen=True, slots=True)
class MachineSample:
    """Time that the machine withheld from the loop in the interval of one sample, about a second."""

    begin_ns: int
    end_ns: int
    taken_ns: tuple[int, ...]  # Excess over a healthy machine, in the order of TAKERS


@dataclass(slots=True)
class MachineHistory:
    """Accumulator of the samples of topic /machine: load, throttling, and time withheld from the loop."""

    _fastest: float = 0.0
    slow: int = 0  # Samples with a core that was hot and far below its highest frequency
    load_samples: list[LoadSample] = field(default_factory=list)

    def new(self, log: Log) -> list[MachineSample]:
        """Add the machine samples in a slice of the log; return the time that each withheld from the loop.

        Raises:
            LogError: A sample cannot be read.
        """
        if LogTopic.MACHINE not in log.topics:
            return []
        return [self._sample(message) for message in log.messages(LogTopic.MACHINE)]

    def compute_load(self, begin_ns: int, end_ns: int) -> MachineLoad:
        """Return the load of the machine between two times, from the samples added so far."""
        meter = LoadMeter(begin_ns, end_ns)
        for sample in self.load_samples:
            meter.add_sample(sample)
        return meter.compute_load()

    def _sample(self, message: Mapping[str, object]) -> MachineSample:
        end_ns, interval_ns = cast("int", message["t_ns"]), cast("int", message["interval_ns"])
        self.load_samples.append(load_sample(message))
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

    def _is_slow(self, message: Mapping[str, object]) -> bool:
        frequency = cast("NDArray[np.float64]", message["frequency"])
        known = frequency[np.isfinite(frequency)]
        if not len(known):
            return False
        self._fastest = max(self._fastest, float(known.max()))
        return float(known.max()) < THROTTLED_SHARE * self._fastest and _number(message["temperature"]) >= HOT


def _of_core(values: object, core: int) -> float:
    """Return the value of one core from an array with a value for each core. If the core is unknown,
    return the greatest; without values, 0."""
    shares = np.nan_to_num(cast("NDArray[np.float64]", values))
    if 0 <= core < len(shares):
        return float(shares[core])
    return float(shares.max(initial=0.0))


def _number(value: object) -> float:
    number = cast("float", value)
    return number if math.isfinite(number) else 0.0
