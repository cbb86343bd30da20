"""Plots of the machine: activity, frequency and temperature of its cores over the run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import cast

import numpy as np
from bokeh.models import Range1d
from numpy.typing import NDArray

from dxlrun import Log
from dxlrun.tooling.topics import LogTopic
from dxlrun_analysis.page.canvas import BLUE, ERROR, Canvas, Plot, PlotLine, many_lines
from dxlrun_analysis.page.envelope import Envelope
from dxlrun_analysis.page.run_curves import Curves

MOST_ROWS = 600
MOST_CORES = 10  # Cores in a plot: the loop's, then the busiest
_BIN_NS = 1_000_000_000  # Interval of the samples
_GAP_NS = 5_000_000_000  # A longer interval without samples is a gap in the curves
_OF_A_CORE = ("busy", "interrupts", "steal", "frequency")
_OF_ALL = ("waiting", "temperature")
_CORES = (
    ("busy", "Cores: busy", "share of the second, %", "%", 10.0),
    ("interrupts", "Cores: interrupts", "share of the second, %", "%", 1.0),
    ("steal", "Cores: steal", "share of the second, %", "%", 1.0),
    ("frequency", "Cores: frequency", "frequency, GHz", "GHz", 0.5),
)
_TEXTS = {
    "busy": "User, system and interrupts together.",
    "steal": "Time given to other guests by the host of a virtual machine.",
}
Numbers = NDArray[np.float64]


class MachineCollector:
    """Accumulator of the samples of topic /machine as curves, such as `busy 0` of core 0."""

    def __init__(self) -> None:
        self._cores = 0
        self._envelope: Envelope | None = None
        self._loop: dict[int, int] = {}  # Number of samples with the loop on each core

    def add_slice(self, log: Log) -> None:
        """Add the machine samples in the next slice of the log.

        Raises:
            LogError: A sample cannot be read.
        """
        if LogTopic.MACHINE not in log.topics:
            return
        for message in log.messages(LogTopic.MACHINE):
            self._add(message)

    def build_curves(self) -> tuple[Curves, tuple[int, ...]]:
        """Return the curves, and the numbers of at most ten cores to draw: those where the loop ran first,
        then the busiest."""
        if self._envelope is None:
            return Curves.from_rows(Envelope(0, 2, 1).rows(), ()), ()
        names = (*(f"{kind} {core}" for kind in _OF_A_CORE for core in range(self._cores)), *_OF_ALL)
        rows = self._envelope.rows().with_gaps(max(_GAP_NS, self._envelope.apart_ns))
        busy = np.nan_to_num(rows.high[:, : self._cores]).sum(axis=0)
        order = sorted(range(self._cores), key=lambda core: (-self._loop.get(core, 0), -busy[core], core))
        return Curves.from_rows(rows, names), tuple(order[:MOST_CORES])

    def _add(self, message: Mapping[str, object]) -> None:
        t_ns, interval_ns = cast("int", message["t_ns"]), cast("int", message["interval_ns"])
        cores = {name: cast("Numbers", message[name]) for name in ("user", "system", "irq", "softirq")}
        interrupts = cores["irq"] + cores["softirq"]
        of_a_core = (
            100 * (cores["user"] + cores["system"] + interrupts),
            100 * interrupts,
            100 * cast("Numbers", message["steal"]),
            cast("Numbers", message["frequency"]) / 1e9,
        )
        if self._envelope is None:
            self._cores = len(interrupts)
            count = len(_OF_A_CORE) * self._cores + len(_OF_ALL)
            self._envelope = Envelope(count, MOST_ROWS, _BIN_NS)
        loop = cast("int", message["loop_core"])
        self._loop[loop] = self._loop.get(loop, 0) + 1
        waiting = cast("float", message["loop_waiting"]) * 1e12 / max(interval_ns, 1)
        of_all = np.array([waiting, cast("float", message["temperature"])])
        values = [*(_of(self._cores, one) for one in of_a_core), of_all]
        row = np.concatenate(values).astype(np.float32)[None, :]
        self._envelope.add_samples(np.array([t_ns]), np.where(np.isfinite(row), row, np.float32(np.nan)))


def _of(cores: int, values: Numbers) -> Numbers:
    """Return an array with a value for each of `cores` cores; NaN for a core that went offline.

    Cores that were added later are ignored.
    """
    found = np.full(cores, np.nan)
    found[: len(values)] = values[:cores]
    return found


def machine_plots(canvas: Canvas, machine: Curves, cores: Iterable[int]) -> list[Plot]:
    """Return the plots of the machine that have content; `cores` are those to draw."""
    plots = []
    if "waiting" in machine:
        plot = canvas.timed("machine-waiting", "The loop waited for a core", "ms in each second", 150)
        canvas.curves(plot, machine, [PlotLine("waiting", "ready to run, no core free", ERROR)], "ms", 1.0)
        plots.append(plot)
    shown = tuple(cores)
    for kind, title, label, unit, least in _CORES:
        lines = many_lines(machine, ((f"{kind} {core}", f"core {core}") for core in shown))
        most = max((float(np.nanmax(machine.high(line.curve))) for line in lines), default=0.0)
        if most <= 0:
            continue
        plot = canvas.timed(f"machine-{kind}", title, label, 180)
        canvas.curves(plot, machine, lines, unit, least)
        if kind != "frequency":
            plot.model.y_range = Range1d(0, 1.06 * max(most, least))
        plot.text = _TEXTS.get(kind, "")
        plots.append(plot)
    if "temperature" in machine:
        plot = canvas.timed("machine-temperature", "Hottest sensor", "temperature, deg C", 150)
        canvas.curves(plot, machine, [PlotLine("temperature", "hottest sensor", BLUE)], "deg C", 4.0)
        plots.append(plot)
    return plots
