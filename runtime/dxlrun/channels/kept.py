"""Kept state: what a controller keeps from one run to the next, on its way out of the loop and back into it.

A state leaves as messages of the topic /kept, in pieces; joined, they are the file that another process
writes: a line with what the file is, as JSON, then the controller's own bytes, then the CRC-32 of all that.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated
from zlib import crc32

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.messages import Header
from dxlrun.messages.cdr import Codec
from dxlrun.messages.declared import Number

TOPIC = "/kept"
MOST_KEPT = 1 << 20
"""Bytes of one controller's state."""
PIECE = 8192
"""Bytes of a state that leave in one cycle: 1 MiB takes 128 cycles."""
LONGEST_FILE = MOST_KEPT + (1 << 18)
"""Bytes; the rest is for the line that says what the file is."""
_MAGIC = b"dxlrun kept state 1 "
_CRC_BYTES = 4

Facts = dict[str, str]
"""What a state was made with: `elbow model` -> `MX-64`."""


@dataclass(slots=True)
class KeptPiece:
    """Message of /kept: a part of a file; those of a file follow each other, from piece 0 on."""

    header: Header
    controller: str
    state: Annotated[int, Number("uint32")]
    """Which of the run's kept states it is a part of, from 0."""
    piece: Annotated[int, Number("uint32")]
    pieces: Annotated[int, Number("uint32")]
    data: NDArray[np.uint8]


class _FirstLine(msgspec.Struct, frozen=True):
    controller: str
    bytes: int
    """Of the controller's own part."""
    made_with: Facts


@dataclass(frozen=True, slots=True)
class KeptFile:
    """What was read for a controller when a run started."""

    place: str
    """Path of the file."""
    state: bytes = b""
    made_with: Facts = field(default_factory=dict)
    problem: str = ""
    """Why it cannot be used; empty: it can."""


@dataclass(frozen=True, slots=True)
class KeptStates:
    """What the controllers of a run may begin with; JSON on its way to the loop, and in the log."""

    files: dict[str, KeptFile] = field(default_factory=dict)
    """By controller."""
    servos: dict[str, Facts] = field(default_factory=dict)
    """What is known about the servo of each joint: another one, and a state does not fit."""


def file_pieces(controller: str, state: bytes, made_with: Facts) -> tuple[int, Iterator[bytes]]:
    """Return how many pieces a file has, and these one by one, of PIECE bytes at most."""
    line = _MAGIC + msgspec.json.encode(_FirstLine(controller, len(state), made_with)) + b"\n"
    return 1 + -(-len(line) // PIECE) + -(-len(state) // PIECE), _pieces(line, state)


def _pieces(line: bytes, state: bytes) -> Iterator[bytes]:
    checksum = 0
    for part in (line, state):
        for start in range(0, len(part), PIECE):
            piece = part[start : start + PIECE]
            checksum = crc32(piece, checksum)
            yield piece
    yield checksum.to_bytes(_CRC_BYTES, "little")


def opened_file(data: bytes, controller: str) -> tuple[bytes, Facts]:
    """Return state and facts of a file. Raises ValueError with the reason when it is none, or not whole."""
    if len(data) > LONGEST_FILE:
        raise ValueError(f"is longer than {LONGEST_FILE} bytes")
    if not data.startswith(_MAGIC):
        raise ValueError("is no kept state of this version")
    end = data.find(b"\n")
    if end < 0 or crc32(data[:-_CRC_BYTES]).to_bytes(_CRC_BYTES, "little") != data[-_CRC_BYTES:]:
        raise ValueError("is damaged or not whole")
    try:
        line = msgspec.json.decode(data[len(_MAGIC) : end], type=_FirstLine)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise ValueError(f"has a first line that cannot be read ({error})") from error
    state = data[end + 1 : -_CRC_BYTES]
    if line.controller != controller:
        raise ValueError(f"is of another controller, {line.controller}")
    if len(state) != line.bytes or len(state) > MOST_KEPT:
        raise ValueError("is not as long as it says")
    return state, line.made_with


def difference(then: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Return the first fact that is another one, as a sentence's part; empty when all are the same."""
    for name in (*now, *(name for name in then if name not in now)):
        was, is_ = then.get(name, "not there"), now.get(name, "not there")
        if was != is_:
            return f"{name} was {was} and is {is_}"
    return ""


class Assembly:
    """Joins pieces to files; memory is bounded by LONGEST_FILE for each controller."""

    def __init__(self, codec: Codec) -> None:
        """`codec` of KeptPiece, as the topic was announced."""
        self._codec = codec
        self._parts: dict[str, tuple[int, list[bytes]]] = {}

    def take(self, data: bytes) -> tuple[str, bytes] | None:
        """Take a message; return controller and file when it was the last piece. A piece that does not follow
        the one before is left out, with all of its file. Raises ValueError when it is no message of /kept."""
        values = self._codec.unpack(data)
        controller, state = str(values["controller"]), int(str(values["state"]))
        piece, pieces = int(str(values["piece"])), int(str(values["pieces"]))
        if piece == 0:
            self._parts[controller] = state, []
        number, parts = self._parts.get(controller, (-1, []))
        if number != state or len(parts) != piece or piece * PIECE > LONGEST_FILE:
            self._parts.pop(controller, None)
            return None
        parts.append(np.asarray(values["data"], np.uint8).tobytes())
        if piece + 1 < pieces:
            return None
        del self._parts[controller]
        return controller, b"".join(parts)

    @property
    def unfinished(self) -> tuple[str, ...]:
        """Controllers of which the last pieces are missing."""
        return tuple(self._parts)
