"""/diagnostics: how each servo is, at most once a second, in words that any ROS tool shows."""

from __future__ import annotations

from typing import Any

import numpy as np

from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.log import schemas
from dxlrun.log.packing.diagnostics import DIAGNOSTICS_NS, Diagnostics
from dxlrun.messages.cdr import Codec
from dxlwire.modes import Mode

JOINTS = ("elbow", "wheel", "head")


def record_of() -> CycleRecord:
    record = CycleRecord(CycleLayout(JOINTS, ()))
    states = record.states
    states.temperature[:] = 41.0, np.nan, 70.0
    states.voltage[:] = 12.04, np.nan, 11.0
    states.valid[:] = True, False, True
    states.hardware_error[:] = 0, 0, 0x24
    states.mode[:] = Mode.POSITION, Mode.UNKNOWN, Mode.EFFORT
    return record


def said(data: bytes | None) -> Any:
    assert data is not None
    return Codec(schemas.DIAGNOSTICS).unpack(data)


def test_each_joint_has_the_status_of_its_servo() -> None:
    record = record_of()
    row = np.frombuffer(bytes(record.raw), dtype=record.layout.dtype)[0]
    message = said(Diagnostics(JOINTS).pack_diagnostics(row, 5, (7, 8)))
    assert message["header"]["stamp"] == {"sec": 7, "nanosec": 8}
    told = [(one["level"], one["name"], one["message"]) for one in message["status"]]
    assert told == [
        (0, "elbow", "answers"),
        (3, "wheel", "did not answer in this cycle"),
        (2, "head", "hardware error 0x24"),
    ]
    values = [[pair["value"] for pair in one["values"]] for one in message["status"]]
    assert values == [
        ["41.0 deg C", "12.0 V", "0x00", "position"],
        ["not read yet", "not read yet", "0x00", "unknown"],
        ["70.0 deg C", "11.0 V", "0x24", "effort"],
    ]


def test_it_is_published_once_a_second() -> None:
    record = record_of()
    row = np.frombuffer(bytes(record.raw), dtype=record.layout.dtype)[0]
    diagnostics = Diagnostics(JOINTS)
    times = [
        time
        for time in range(0, 5 * DIAGNOSTICS_NS, DIAGNOSTICS_NS // 50)
        if diagnostics.pack_diagnostics(row, time, (0, 0))
    ]
    assert times == [second * DIAGNOSTICS_NS for second in range(5)]
