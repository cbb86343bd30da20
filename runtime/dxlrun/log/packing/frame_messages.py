"""Messages of /tf and /tf_static: where the frames of a robot lie, from its URDF and the record of a cycle.

A frame whose joint was never read is in no message until it was. A joint that is not read any more stays
where it was read last, as the record has it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dxlrun.description.frames.tree import Frame, FramesPlan, FrameTree
from dxlrun.log.schemas import FRAMES, LogHeader
from dxlrun.messages.cdr import Codec
from dxlsim.geometry.transform import Quaternion, Transform, near

Stamp = tuple[int, int]
"""Seconds since 1970 and the nanoseconds behind them."""


class FrameMessages:
    """Makes a message of /tf of a cycle when the last one is old enough, and that of /tf_static.

    Raises InputError where the URDF is wrong, or does not fit the plan: the compiler has checked both.
    """

    def __init__(self, urdf: str, plan: FramesPlan, header: LogHeader) -> None:
        self._tree = FrameTree.of(urdf, plan)
        self._rows = {name: row for row, name in enumerate(header.joints) if name in plan.moved}
        self._turns = {
            name: at
            for at, name in enumerate(header.layout.source_states)
            if plan.imu and name.partition("/")[0] == plan.imu
        }
        self._moving = [frame for frame in self._tree.frames if frame.moves]
        self._still = [frame for frame in self._tree.frames if frame.parent and not frame.moves]
        self._interval_ns = round(1e9 / plan.rate)
        self._slot: int | None = None
        self._last: dict[str, Quaternion] = {}

    @property
    def any_still(self) -> bool:
        """Whether there is something for /tf_static."""
        return bool(self._still)

    def still(self, stamp: Stamp) -> bytes:
        """Return the message of the frames that never move in their parents."""
        found = [(frame, self._tree.local(frame, {})) for frame in self._still]
        return _packed(stamp, [(frame, local) for frame, local in found if local is not None])

    def of(self, record: np.void, stamp: Stamp) -> bytes | None:
        """Return the message of a cycle; None while the one before is new, or nothing is known yet."""
        slot = int(record["scheduled_ns"]) // self._interval_ns
        if slot == self._slot:
            return None
        self._slot = slot
        read: Sequence[float] = record["position"].tolist()
        positions = {name: read[row] for name, row in self._rows.items()}
        measured: Sequence[float] = record["source_state"].tolist()
        orientation = self._tree.orientation({name: measured[at] for name, at in self._turns.items()})
        found = []
        for frame in self._moving:
            local = self._tree.local(frame, positions, orientation)
            if local is not None:
                found.append((frame, self._continued(frame.name, local)))
        return _packed(stamp, found) if found else None

    def _continued(self, name: str, local: Transform) -> Transform:
        """Return a transform whose quaternion has the sign of the one before."""
        rotation = near(local.rotation, self._last.get(name, local.rotation))
        self._last[name] = rotation
        return Transform(local.translation, rotation)


_CODEC = Codec(FRAMES)


def _packed(stamp: Stamp, found: Sequence[tuple[Frame, Transform]]) -> bytes:
    return _CODEC.pack(
        [((stamp, frame.parent), frame.name, (local.translation, local.rotation)) for frame, local in found]
    )


def frame_messages(header: LogHeader) -> FrameMessages | None:
    """Return what makes the messages of a log; None: its robot has no URDF, or asks for none."""
    if header.frames is None or not header.frames.rate or header.robot_description is None:
        return None
    return FrameMessages(header.robot_description, header.frames, header)
