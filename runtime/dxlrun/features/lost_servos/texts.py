"""Texts of the policies for lost servos: their events."""

from __future__ import annotations

from dxlrun.channels.events import EventCode, Severity, event_text


@event_text(EventCode.POLICY, Severity.ERROR)
def group_is_limp(group: str) -> str:
    return f"group {group} lost a servo: it is limp until a client requests torque"
