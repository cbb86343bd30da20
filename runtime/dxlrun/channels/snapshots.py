"""Snapshots: the state of a loop and of its controllers in the middle of a run, on its way into the log.

Every 10 s the loop's own state, then that of each controller, of a cycle each, as messages of /snapshots in
pieces. A replay begins with them where the log lacks what came before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from dxlrun.messages import Header
from dxlrun.messages.declared import Number

TOPIC = "/snapshots"
INTERVAL_NS = 10_000_000_000
"""Between two rounds."""
PIECE = 8192
"""Bytes that leave in one cycle."""
MOST_PIECES = 1024
"""Of one state: 8 MiB."""


@dataclass(slots=True)
class SnapshotPiece:
    """Message of /snapshots: a part of a state; those of a state follow each other, from piece 0 on."""

    header: Header
    cycle: int
    """At the end of which the state was this."""
    controller: str
    """Empty: the loop itself, with which a round begins."""
    piece: Annotated[int, Number("uint32")]
    pieces: Annotated[int, Number("uint32")]
    data: NDArray[np.uint8]


def pieces_of(data: bytes) -> tuple[int, Iterator[bytes]]:
    """Return how many pieces a state has, one at least, and these one by one."""
    starts = range(0, max(1, len(data)), PIECE)
    return len(starts), (data[start : start + PIECE] for start in starts)
