"""Plan of the lights: data of the section for the run."""

from __future__ import annotations

import msgspec


class Light(msgspec.Struct, frozen=True):
    """A light that was found on its servo."""

    joint: str
    bus: str
    servo_id: int
    address: int  # LED item in the servo's control table


def decode_lights(plan: bytes) -> dict[str, Light]:
    """Return the lights of `Contribution.plan` by name."""
    return msgspec.json.decode(plan, type=dict[str, Light])
