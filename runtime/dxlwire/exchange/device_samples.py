"""Device samples: replies of devices -> their states in the cycle's record, in SI units."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dxlwire.bus_plan import BusPlan
from dxlwire.exchange.arrays import Floats, SourceArrays
from dxlwire.exchange.reports import Reason, ReportSink

REPORT_AGAIN_NS = 1_000_000_000  # One device has at most one event in this time


class DeviceSamples:
    """What came of all devices; blocks are in the order of the plans.

    A device's row is valid when all its blocks came in this cycle and all their values are finite; else it
    keeps its values, is invalid, and its age grows.
    """

    def __init__(self, plans: Sequence[BusPlan], sources: SourceArrays, reports: ReportSink) -> None:
        self.sources = sources  # Those of the cycle's record
        self._reports = reports
        devices = [(plan, device) for plan in plans for device in plan.devices]
        blocks = [block for _, device in devices for block in device.blocks]
        self.values: Floats = np.full(len(sources.values), np.nan)
        """By the newest intact replies, at the columns of `source_states`."""
        self.fresh = np.zeros(len(blocks), dtype=np.bool_)
        """True where an intact reply arrived in this cycle."""
        self.at_ns = np.full(len(blocks), -1, dtype=np.int64)
        """Time at which the newest reply arrived; -1 while none ever did."""
        self.shown_ns = np.full(len(devices), -1, dtype=np.int64)
        """Time of the oldest reply among those that the states show, of each device; -1: they show none."""
        self.doubted = np.zeros(len(devices), dtype=np.bool_)
        """True where the replies of this cycle are not believed."""
        self._fields = [block.fields for block in blocks]
        self._devices: list[tuple[str, str, slice, list[int]]] = []
        first = 0
        for plan, device in devices:
            here = slice(first, first + len(device.blocks))
            first = here.stop
            columns = [field.column for block in device.blocks for field in block.fields]
            self._devices.append((device.name, plan.label(device), here, columns))
        self._reported_ns = [-REPORT_AGAIN_NS] * len(devices)

    def judge(self, now_ns: int) -> None:
        """Doubt each device that sent something that is no finite number in this cycle."""
        for number, (_, _, here, columns) in enumerate(self._devices):
            if self.fresh[here].all() and not np.isfinite(self.values[columns]).all():
                self._report(number, now_ns)
                self.doubted[number] = True

    def _report(self, number: int, now_ns: int) -> None:
        if now_ns - self._reported_ns[number] >= REPORT_AGAIN_NS:
            self._reported_ns[number] = now_ns
            name, label, here, _ = self._devices[number]
            wrong = [
                field.state
                for fields in self._fields[here]
                for field in fields
                if not math.isfinite(self.values[field.column])
            ]
            text = f"{label} sent no finite {', '.join(wrong)}: not believed"
            self._reports.report(Reason.IMPLAUSIBLE, name, text)
