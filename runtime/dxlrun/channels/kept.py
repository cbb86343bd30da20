"""Kept state: format of the state that a controller keeps from one run to the next, in messages and files.

The loop publishes a state in pieces as messages of the topic /kept. Another process joins them to a file: a
line of JSON that describes the file, the controller's bytes, and the CRC-32 of both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
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
"""Longest state of a controller, bytes."""
PIECE = 8192
"""Longest piece of a kept state, bytes. One piece is published a cycle, so 1 MiB takes 128 cycles."""
LONGEST_FILE = MOST_KEPT + (1 << 18)
"""Longest file of a kept state, bytes, with 256 KiB for its first line."""
_MAGIC = b"dxlrun kept state 1 "
_CRC_BYTES = 4

Facts = dict[str, str]
"""Facts about servos and controllers on which a kept state depends, by name: `elbow model` -> `MX-64`."""


@dataclass(slots=True)
class KeptPiece:
    """Message of /kept: a piece of the file of a controller's state.

    Pieces are published in sequence from 0.
    """

    header: Header
    controller: str
    state: Annotated[int, Number("uint32")]
    """Number of the kept state in the run, from 0; the same for all its pieces."""
    piece: Annotated[int, Number("uint32")]
    pieces: Annotated[int, Number("uint32")]
    data: NDArray[np.uint8]


class _FirstLine(msgspec.Struct, frozen=True):
    controller: str
    bytes: int
    """Length of the controller's state, bytes."""
    made_with: Facts


class KeptFile(msgspec.Struct, frozen=True):
    """File with the state that a controller kept in an earlier run, as read at the start of a run."""

    place: str
    """Path of the file."""
    state: bytes = b""
    made_with: Facts = msgspec.field(default_factory=dict)
    problem: str = ""
    """Reason why the file cannot be used; empty if it can."""


class KeptStates(msgspec.Struct, frozen=True):
    """States that controllers kept in earlier runs; passed to the loop and logged as JSON."""

    files: dict[str, KeptFile] = msgspec.field(default_factory=dict)
    """File of each controller that kept a state, by controller name."""
    servos: dict[str, Facts] = msgspec.field(default_factory=dict)
    """Facts about the servo of each joint. A state does not fit after the servo was replaced."""


def file_pieces(controller: str, state: bytes, made_with: Facts) -> tuple[int, Iterator[bytes]]:
    """Encode a controller's state as a file; return the number of pieces and an iterator of the pieces."""
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
    """Return a controller's state and its facts from a file's bytes. Raises ValueError with the reason."""
    if len(data) > LONGEST_FILE:
        raise ValueError(f"is longer than {LONGEST_FILE} bytes")
    if not data.startswith(_MAGIC):
        raise ValueError("is not a state of a controller, or was saved by another version")
    end = data.find(b"\n")
    if end < 0 or crc32(data[:-_CRC_BYTES]).to_bytes(_CRC_BYTES, "little") != data[-_CRC_BYTES:]:
        raise ValueError("is damaged or incomplete")
    try:
        line = msgspec.json.decode(data[len(_MAGIC) : end], type=_FirstLine)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise ValueError(f"has an unreadable first line ({error})") from error
    state = data[end + 1 : -_CRC_BYTES]
    if line.controller != controller:
        raise ValueError(f"belongs to another controller, {line.controller}")
    if len(state) != line.bytes or len(state) > MOST_KEPT:
        raise ValueError("has the wrong length")
    return state, line.made_with


def difference(then: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Return the first fact that has changed, as a clause:

    `elbow model was MX-64, now MX-28`; empty if equal.
    """
    for name in (*now, *(name for name in then if name not in now)):
        was, is_ = then.get(name, "absent"), now.get(name, "absent")
        if was != is_:
            return f"{name} was {was}, now {is_}"
    return ""


class Assembly:
    """Joins messages of /kept to files. Memory is bounded by LONGEST_FILE for each controller.

    Args:
        codec: Codec of KeptPiece, as the topic was announced.
    """

    def __init__(self, codec: Codec) -> None:
        self._codec = codec
        self._parts: dict[str, tuple[int, list[bytes]]] = {}

    def add_piece(self, data: bytes) -> tuple[str, bytes] | None:
        """Add a message of /kept; return controller and file if it was the last piece of a file.

        A piece out of sequence drops its file.

        Returns:
            Controller and file after the last piece, else None.

        Raises:
            ValueError: The data are not a message of /kept.
        """
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
        """Names of the controllers whose files still lack pieces."""
        return tuple(self._parts)
