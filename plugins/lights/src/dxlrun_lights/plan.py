"""Plan of the lights: the checked section as the processes of a run read it."""

from __future__ import annotations

import msgspec


class LightPlan(msgspec.Struct, frozen=True):
    """A light with the bus, ID and address at which its LED is written."""

    joint: str
    bus: str
    servo_id: int
    address: int  # LED item in the servo's control table


def decode_lights(plan: bytes) -> dict[str, LightPlan]:
    """Return the lights by name from the JSON of `Contribution.plan`."""
    return msgspec.json.decode(plan, type=dict[str, LightPlan])
