"""Device samples: converts the replies of devices to their states in the cycle's record, in SI units."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dxlwire.bus_plan import BusPlan
from dxlwire.exchange import reports
from dxlwire.exchange.arrays import Floats, SourceArrays
from dxlwire.exchange.reports import Reason, ReportSink

REPORT_AGAIN_NS = 1_000_000_000  # Minimum interval between two events of one device


class DeviceSamples:
    """Newest values of all devices of a robot; blocks are in the order of the plans.

    A device's row is valid when all its blocks arrived in this cycle and all their values are finite.
    Otherwise it keeps its values, is marked invalid, and its age grows."""

    def __init__(self, plans: Sequence[BusPlan], sources: SourceArrays, reports: ReportSink) -> None:
        self.sources = sources  # Source arrays of the cycle's record
        self._reports = reports
        devices = [(plan, device) for plan in plans for device in plan.devices]
        blocks = [block for _, device in devices for block in device.blocks]
        self.values: Floats = np.full(len(sources.values), np.nan)
        """Values in the newest intact replies, SI units, at the columns of `source_states`; NaN before the
        first reply."""
        self.fresh = np.zeros(len(blocks), dtype=np.bool_)
        """True for each block whose intact reply arrived in this cycle."""
        self.at_ns = np.full(len(blocks), -1, dtype=np.int64)
        """Arrival time of each block's newest reply, ns; -1 before the first reply."""
        self.shown_ns = np.full(len(devices), -1, dtype=np.int64)
        """Arrival time of the oldest reply among those that each device's states come from, ns; -1 before
        the first."""
        self.doubted = np.zeros(len(devices), dtype=np.bool_)
        """True for each device whose values of this cycle are rejected because one is not finite."""
        self._fields = [block.fields for block in blocks]
        self._devices: list[tuple[str, str, slice, list[int]]] = []
        first = 0
        for plan, device in devices:
            here = slice(first, first + len(device.blocks))
            first = here.stop
            columns = [field.column for block in device.blocks for field in block.fields]
            self._devices.append((device.name, plan.label(device), here, columns))
        self._reported_ns = [-REPORT_AGAIN_NS] * len(devices)

    def reject_non_finite(self, now_ns: int) -> None:
        """Reject and report each device that sent a NaN or an infinite value in this cycle."""
        for number, (_, _, here, columns) in enumerate(self._devices):
            if self.fresh[here].all() and not np.isfinite(self.values[columns]).all():
                self._report_device(number, now_ns)
                self.doubted[number] = True

    def _report_device(self, number: int, now_ns: int) -> None:
        if now_ns - self._reported_ns[number] >= REPORT_AGAIN_NS:
            self._reported_ns[number] = now_ns
            name, label, here, _ = self._devices[number]
            wrong = [
                field.state
                for fields in self._fields[here]
                for field in fields
                if not math.isfinite(self.values[field.column])
            ]
            self._reports.report(Reason.IMPLAUSIBLE, name, reports.not_finite(label, wrong))
