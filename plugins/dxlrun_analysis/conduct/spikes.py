"""Values of devices that jump: far beyond their own noise, and back within a sample or two, many times.

In blocks of 256 samples: a value's noise is the median of its changes from one sample to the next. It jumps
where it is 30 times as far from the median of five samples in a row, of which three are closer together than
an eighth of that. So a step is none, as it stays; nor is what has few values, as a button, or rests to the
bit. It is told from ten jumps on, of a value that jumps alone: an impact shakes the others, too.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from dxlrun.channels.cycle import Floats
from dxlrun.log.reader import Log
from dxlrun_analysis.finding import Finding
from dxlrun_analysis.plan import LoggedDevice, plan_of

_BLOCK = 256
_SHORTEST = 64  # Samples of the last block
_WINDOW = 5
_TIMES_NOISE = 30
_TOGETHER = 1 / 8
_FEWEST_VALUES = 16  # In a block, of one that trembles
_FEWEST = 10
_ALONE = 0.8  # Share of the jumps of a value in which no other of its device jumps


class _Device:
    """The values of one device, block by block."""

    def __init__(self, bus: str, plan: LoggedDevice, states: tuple[str, ...]) -> None:
        self.bus, self.plan, self.states = bus, plan, states
        self.samples = 0
        self.jumps, self.alone = np.zeros((2, len(states)), np.int64)
        self.largest, self.noise = np.zeros((2, len(states)))
        """The farthest jump of each state, and its noise then."""
        self._waiting: Floats = np.zeros((0, len(states)))

    def take(self, values: Floats) -> None:
        """Take samples, shape (samples, states); those that are the same to the bit are one."""
        joined = np.concatenate([self._waiting, values])
        joined = joined[np.append(True, np.diff(joined, axis=0).any(axis=1))[: len(joined)]]
        while len(joined) >= _BLOCK:
            self._count(joined[:_BLOCK])
            joined = joined[_BLOCK - _WINDOW + 1 :]
        self._waiting = joined

    def finish(self) -> None:
        """Count the samples that are left, where they are enough."""
        if len(self._waiting) >= _SHORTEST:
            self._count(self._waiting)
        self._waiting = self._waiting[:0]

    def _count(self, block: Floats) -> None:
        noise = np.median(np.abs(np.diff(block, axis=0)), axis=0)
        several = np.array([len(np.unique(column)) >= _FEWEST_VALUES for column in block.T])
        windows = sliding_window_view(block, _WINDOW, axis=0)
        off = np.abs(windows - np.median(windows, axis=2, keepdims=True))
        far = off[:, :, _WINDOW // 2]
        jumps = (far > _TIMES_NOISE * noise) & (np.sort(off, axis=2)[:, :, 2] < _TOGETHER * far)
        others = jumps.sum(axis=1, keepdims=True) > 1
        jumps &= several & (noise > 0)
        size = np.where(jumps, far, 0.0).max(axis=0)
        self.noise = np.where(size > self.largest, noise, self.noise)
        self.largest = np.maximum(size, self.largest)
        self.samples += len(windows)
        self.jumps += jumps.sum(axis=0)
        self.alone += (jumps & ~others).sum(axis=0)


class Spikes:
    """Finds values of devices that jump and come back, in memory that does not grow with the log."""

    def __init__(self) -> None:
        self._devices: dict[str, _Device] = {}

    def take(self, log: Log) -> None:
        """Take the cycles of the next slice."""
        if not len(log.cycles):
            return
        of_bus = {each.name: (bus.name, each) for bus in plan_of(log).buses for each in bus.devices}
        for index, (name, states) in enumerate(log.header.sources.items()):
            if name not in of_bus or not states:
                continue
            valid = log.cycles["source_valid"][:, index]
            values = log.cycles["source_state"][:, log.header.layout.source_slice(name)][valid]
            if name not in self._devices:
                self._devices[name] = _Device(*of_bus[name], tuple(states))
            self._devices[name].take(np.nan_to_num(values))

    def findings(self) -> Iterable[Finding]:
        """Tell which value of which device jumps."""
        for name, one in self._devices.items():
            one.finish()
            for index, (state, count) in enumerate(zip(one.states, one.jumps.tolist(), strict=True)):
                if count < _FEWEST or one.alone[index] < _ALONE * count:
                    continue
                times = one.largest[index] / one.noise[index]
                yield Finding(
                    "device_jumps",
                    name,
                    f"Device {name} (ID {one.plan.servo_id} on bus {one.bus}) has values that jump: {state} "
                    f"{count} times ({count / one.samples:.1%} of its samples), by up to "
                    f"{one.largest[index]:.4g}, {times:.0f} times its own noise, and was back within two "
                    "samples.",
                    "Look at what it measures with, and at the contacts of that.",
                    share=0.6,
                )
