"""Machine load: decide from the recorder's samples whether the machine was too busy for a run.

A sample has the load of the cores and of the loop's process in an interval; dxlrun/log/machine.py takes one a
second. The recorder, the run summary and the analysis of a log use this module.
"""

from __future__ import annotations

import msgspec

from dxlrun.errors import counted

SAMPLE_PERIOD_NS = 1_000_000_000
"""Time between two samples of the machine's load, ns."""
_SILENT_NS = 2 * SAMPLE_PERIOD_NS
"""Interval after which at least one sample is missing. The sampler has ordinary priority, unlike the loop."""
_IDLE_SHARE = 0.05  # /proc/stat counts in steps of 10 ms; a core with less idle time counts as busy
_STOLEN_SHARE = 0.05
_WAITED_SHARE = 0.01  # of a second: ten cycles of a loop at 1 kHz
_SPARE_SHARE = 0.5  # with so much idle time, a late sampler did not wait for a core
_SHORTEST_NS = 100_000_000  # ten steps of /proc/stat; shorter samples are too coarse
_FEWEST_BUSY_S = 3.0
_BUSY_PART = 0.1
_MOST_PART = 0.5


class LoadSample(msgspec.Struct, frozen=True):
    """Load of the machine in an interval, sampled by the recorder; NaN: the system does not report it."""

    begin_ns: int
    end_ns: int
    most_idle: float
    """Share of the interval in which the idlest core was idle."""
    most_stolen: float
    """Largest share of the interval that the host of a virtual machine withheld from a core."""
    loop_waiting: float
    """Share of the interval in which the loop's process was ready to run but had no core."""


class MachineLoad(msgspec.Struct, frozen=True):
    """Seconds of an interval in which the machine was too busy. Samples count by their overlap.

    Example:
        >>> MachineLoad(seconds=6.0, busy_s=5.2, no_idle_core_s=5.2).text
        'no core was idle in 5.2 of 6 s'
    """

    seconds: float = 0.0
    """Length of the interval, as far as there are samples or long gaps between them."""
    busy_s: float = 0.0
    """Time in which at least one of the following conditions was true, s."""
    no_idle_core_s: float = 0.0
    waited_s: float = 0.0
    """Time of samples in which the loop was ready to run without a core for more than 1 %."""
    stolen_s: float = 0.0
    """Time of samples in which the host withheld more than 5 % of a core."""
    silent_s: float = 0.0
    """Time of gaps of 2 s or longer between the recorder's samples."""

    @property
    def share(self) -> float:
        """Share of the interval in which the machine was busy, 0..1; 0 unless `too_busy`."""
        return self.busy_s / self.seconds if self.too_busy else 0.0

    @property
    def too_busy(self) -> bool:
        """True if the machine was busy for a tenth of the interval, and for 3 s or half of the interval."""
        lasting = self.busy_s >= min(_FEWEST_BUSY_S, _MOST_PART * self.seconds)
        return self.busy_s > 0 and lasting and self.busy_s >= _BUSY_PART * self.seconds

    @property
    def clause(self) -> str:
        """Clause that says how long the machine was busy, and how; empty if it never was."""
        observed = (
            (self.no_idle_core_s, "no core was idle in"),
            (self.waited_s, "the loop waited for a core in"),
            (self.stolen_s, "the host withheld cores in"),
            (self.silent_s, "the recorder took no sample in"),
        )
        of = f"of {_seconds(self.seconds)} s"
        return ", ".join(f"{text} {_seconds(value)} {of}" for value, text in observed if value >= 0.05)


class SimulationWait(msgspec.Struct, frozen=True):
    """Time for which the loop waited for late replies because the simulation did not run."""

    waited_ns: int = 0
    times: int = 0

    @property
    def clause(self) -> str:
        """Clause that says how often and how long the loop waited; empty without a wait."""
        if not self.times:
            return ""
        times = counted(self.times, "time", "times")
        return (
            f"the loop waited {times}, {self.waited_ns / 1e6:.0f} ms in all, for the process of the "
            "simulated servos"
        )


NO_WAIT = SimulationWait()


def describe_busy_machine(load: MachineLoad, wait: SimulationWait = NO_WAIT) -> str:
    """Return a sentence if the machine was too busy or the simulation stalled; else an empty string."""
    observed = ", ".join(filter(None, (load.clause if load.too_busy else "", wait.clause)))
    return f"The machine was too busy: {observed}." if observed else ""


class LoadMeter:
    """Sums up the load samples of one interval, in constant memory.

    Args:
        begin_ns: Begin of the interval, ns of the run's clock.
        end_ns: End of the interval; None: not known yet, or the end of the last sample.
    """

    def __init__(self, begin_ns: int, end_ns: int | None = None) -> None:
        self.end_ns = end_ns
        self._begin_ns = begin_ns
        self._first_ns: int | None = None
        self._last_ns = begin_ns
        self._ns = dict.fromkeys(("sampled", "busy", "no_idle_core", "waited", "stolen", "silent"), 0)

    def add_sample(self, sample: LoadSample) -> None:
        """Add the part of a sample that overlaps the interval. Samples must be sorted by time."""
        end_ns = sample.end_ns if self.end_ns is None else min(sample.end_ns, self.end_ns)
        begin_ns = max(sample.begin_ns, self._begin_ns)
        if begin_ns >= end_ns:
            return
        if self._first_ns is None:
            self._first_ns = begin_ns
        self._last_ns = max(self._last_ns, end_ns)
        length_ns = sample.end_ns - sample.begin_ns
        if length_ns < _SHORTEST_NS:
            return
        found = {
            "no_idle_core": sample.most_idle < _IDLE_SHARE,
            "waited": sample.loop_waiting > _WAITED_SHARE,
            "stolen": sample.most_stolen > _STOLEN_SHARE,
            "silent": length_ns > _SILENT_NS and not sample.most_idle >= _SPARE_SHARE,
        }
        found |= {"sampled": True, "busy": any(found.values())}
        for name, is_true in found.items():
            self._ns[name] += is_true * (end_ns - begin_ns)

    def compute_load(self) -> MachineLoad:
        """Return the sums of the samples so far.

        Gaps of 2 s or longer before the first and after the last sample count as busy. An interval without
        samples has no load.
        """
        silent_ns = 0
        if self._first_ns is not None:
            gaps_ns = (self._first_ns - self._begin_ns, (self.end_ns or self._last_ns) - self._last_ns)
            silent_ns = sum(gap_ns for gap_ns in gaps_ns if gap_ns >= _SILENT_NS)
        seconds = {name: ns / 1e9 for name, ns in self._ns.items()}
        silent_s = silent_ns / 1e9
        return MachineLoad(
            seconds["sampled"] + silent_s,
            seconds["busy"] + silent_s,
            seconds["no_idle_core"],
            seconds["waited"],
            seconds["stolen"],
            seconds["silent"] + silent_s,
        )


def _seconds(value: float) -> str:
    """Format seconds with one decimal, without a trailing zero."""
    return f"{value:.1f}".removesuffix(".0")
