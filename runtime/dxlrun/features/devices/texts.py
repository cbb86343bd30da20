"""Texts of the events that devices cause. `device` is a label with name, ID and bus."""

from __future__ import annotations

from dxlrun.channels.event_records import EventCode, Severity, event_text


@event_text(EventCode.SETUP, Severity.INFO)
def device_found(model: str, device_id: int, bus: str) -> str:
    return f"{model}, ID {device_id} on bus {bus}"


@event_text(EventCode.SETUP, Severity.WARNING)
def device_read_apart(device: str) -> str:
    return f"{device} does not answer combined reads; it is read alone from now on"


@event_text(EventCode.READ_LOST, Severity.WARNING)
def reply_missed(device: str) -> str:
    return f"{device} did not answer"


@event_text(EventCode.READ_LOST, Severity.WARNING)
def reply_garbled(device: str) -> str:
    return f"{device} sent a garbled reply"


@event_text(EventCode.READ_BACK, Severity.INFO)
def device_answers_again(device: str, lost: int) -> str:
    return f"{device} answers again; {'1 reply was' if lost == 1 else f'{lost} replies in a row were'} lost"


@event_text(EventCode.DEVICE_LOST, Severity.ERROR)
def device_lost(device: str, missed: int) -> str:
    return f"{device} missed {missed} replies in a row; it is probed once a second until it is back"


@event_text(EventCode.DEVICE_LOST, Severity.ERROR)
def device_silent_in_cycles(device: str) -> str:
    return f"{device} answers single reads, but not those of the cycles; it is probed once a second"


@event_text(EventCode.DEVICE_LOST, Severity.ERROR)
def device_unfit(device: str, problem: str) -> str:
    return f"{device} {problem}"


@event_text(EventCode.DEVICE_BACK, Severity.INFO)
def device_back(device: str) -> str:
    return f"{device} is back, and is read again"


@event_text(EventCode.SERVO_ERROR, Severity.WARNING)
def error_byte_set(device: str, errors: str) -> str:
    return f"{device} reports {errors}"


@event_text(EventCode.SERVO_ERROR, Severity.INFO)
def error_byte_cleared(device: str, errors: str) -> str:
    return f"{device} reports {errors}"


@event_text(EventCode.SERVO_ERROR, Severity.WARNING)
def command_refused(device: str, register: str, value: int, errors: str) -> str:
    return f"{device} refuses {register} = {value}: {errors}"
