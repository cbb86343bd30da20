"""Plan of the lights: what the run needs of the section."""

from __future__ import annotations

import msgspec


class Light(msgspec.Struct, frozen=True):
    """A light that was found on its servo."""

    servo: str  # Joint that the servo moves
    address: int  # LED item in the servo's control table
