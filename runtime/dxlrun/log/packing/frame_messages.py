"""Frame messages: packs the poses of a robot's frames into messages of /tf and /tf_static.

A frame is omitted until its joint was read once. A joint that is no longer read keeps its last position, as
in the record.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dxlrun.description.frames.tree import Frame, FramesPlan, FrameTree
from dxlrun.log.schemas import FRAMES, LogHeader
from dxlrun.messages.cdr import Codec
from dxlsim.geometry.transform import Quaternion, Transform, near

Stamp = tuple[int, int]
"""Seconds since 1970 and the remaining nanoseconds."""


class FrameMessages:
    """Makes messages of /tf from cycle records, at the rate of the plan, and the message of /tf_static.

    Raises InputError when the URDF is wrong or does not fit the plan; the compiler has checked both.
    """

    def __init__(self, urdf: str, plan: FramesPlan, header: LogHeader) -> None:
        self._tree = FrameTree.from_urdf(urdf, plan)
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
        """True if the robot has frames that never move, so that /tf_static is needed."""
        return bool(self._still)

    def still(self, stamp: Stamp) -> bytes:
        """Return the encoded message of /tf_static: the poses of frames that never move in their parents."""
        found = [(frame, self._tree.local(frame, {})) for frame in self._still]
        return _packed(stamp, [(frame, local) for frame, local in found if local is not None])

    def pack_frames(self, record: np.void, stamp: Stamp) -> bytes | None:
        """Return the encoded message of /tf for a cycle; None if none is due or no pose is known."""
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
        """Return a pose with its quaternion's sign closest to the frame's last one (q and -q are equal)."""
        rotation = near(local.rotation, self._last.get(name, local.rotation))
        self._last[name] = rotation
        return Transform(local.translation, rotation)


_CODEC = Codec(FRAMES)
_RESOLUTION = 2.0**24
"""Steps of a quaternion's element from 0 to 1: about 1e-7 rad, a ten thousandth of a step of a servo. All
digits of sines and cosines took a fifth of a log."""


def _packed(stamp: Stamp, found: Sequence[tuple[Frame, Transform]]) -> bytes:
    return _CODEC.pack(
        [
            ((stamp, frame.parent), frame.name, (local.translation, _rounded(local.rotation)))
            for frame, local in found
        ]
    )


def _rounded(rotation: Quaternion) -> Quaternion:
    x, y, z, w = (round(element * _RESOLUTION) / _RESOLUTION for element in rotation)
    return x, y, z, w


def frame_messages(header: LogHeader) -> FrameMessages | None:
    """Return the maker of a log's frame messages; None without a URDF, a frames plan, or with rate 0."""
    if header.frames is None or not header.frames.rate or header.robot_description is None:
        return None
    return FrameMessages(header.robot_description, header.frames, header)
