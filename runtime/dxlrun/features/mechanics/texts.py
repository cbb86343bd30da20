"""Texts of the events about servos that move one joint together, and about transmissions."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.channels.event_records import EventCode, Severity, event_text


@event_text(EventCode.TORQUE_ON, Severity.WARNING)
def torque_refused(coupling: str, problem: str) -> str:
    return f"{coupling} gets no torque: {problem}"


@event_text(EventCode.TORQUE_OFF, Severity.WARNING)
def partners_released(coupling: str, limp: Sequence[str], others: Sequence[str]) -> str:
    return (
        f"{coupling}: torque is switched off on {' and '.join(others)}, as {' and '.join(limp)} of the same "
        "mechanism is limp"
    )


@event_text(EventCode.SERVOS_DISAGREE, Severity.WARNING)
def servos_disagree(disagreement: str) -> str:
    return f"{disagreement}: is a gear or a horn slipping?"


@event_text(EventCode.SERVOS_DISAGREE, Severity.INFO)
def servos_agree_again(coupling: str, spread: str) -> str:
    return f"the servos of {coupling} agree again, within {spread}"
