"""Texts of events about servos, buses and settings in the log of a run.

Each function takes the fields of one event and returns its text; the decorator has code and severity. `servo`
is a label with joint, ID and bus.
"""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.channels.event_records import EventCode, Severity, event_text
from dxlwire.exceptions import counted

# Start-up


@event_text(EventCode.SETUP, Severity.INFO)
def servo_found(model: str, servo_id: int, bus: str, firmware: int) -> str:
    return f"{model}, ID {servo_id} on bus {bus}, firmware {firmware}"


@event_text(EventCode.SETUP, Severity.INFO)
def turn_found(servo: str, raw: int, turn: int) -> str:
    return f"{servo} counts turns: it reports position {raw}, which is in turn {turn} of its joint's travel"


@event_text(EventCode.SETUP, Severity.INFO)
def torque_limit_restored(register: str, before: int, now: int) -> str:
    return f"{register} was restored from {before} to {now}"


@event_text(EventCode.SETUP, Severity.WARNING)
def fast_reads_refused(bus: str, refusals: str, total_ns: int, planned_ns: int) -> str:
    return (
        f"bus {bus} does not use fast reads: {refusals}; a cycle takes {total_ns / 1e6:.2f} ms instead of "
        f"{planned_ns / 1e6:.2f} ms (at most {1e9 / total_ns:.0f} Hz)"
    )


@event_text(EventCode.SETUP, Severity.WARNING)
def fast_reads_given_up(bus: str, count: int, servos: str) -> str:
    return (
        f"bus {bus}: {count} fast reads in a row were incomplete; plain reads are used for {servos}: check "
        "their firmware and contacts"
    )


@event_text(EventCode.MODE, Severity.WARNING)
def start_mode_set(servo: str, before: str, mode: str) -> str:
    return f"{servo} was set to {mode} mode ({before})"


@event_text(EventCode.TORQUE_ON, Severity.INFO)
def torque_is_on(joints: str) -> str:
    return f"torque is on: {joints}"


@event_text(EventCode.TORQUE_OFF, Severity.INFO)
def joints_start_limp(joints: str) -> str:
    return f"torque stays off because of `torque: off` in the robot file: {joints}"


# Registers


@event_text(EventCode.REGISTER_WRITTEN, Severity.INFO)
def register_written(register: str, before: str, now: int) -> str:
    return f"{register} was changed from {before} to {now}"


@event_text(EventCode.REGISTER_DIFFERS, Severity.INFO)
def register_changed(servo: str, register: str, before: int, now: int) -> str:
    return f"{servo}: {register} changed from {before} to {now}"


@event_text(EventCode.REGISTER_DIFFERS, Severity.WARNING)
def register_check_failed(problem: str) -> str:
    return problem


@event_text(EventCode.REGISTER_DIFFERS, Severity.WARNING)
def register_not_written(problem: str) -> str:
    return problem


@event_text(EventCode.REGISTER_DIFFERS, Severity.WARNING)
def settings_differ(servo: str, settings: str, remedies: str) -> str:
    return f"{servo} differs from the factory settings: {settings}; {remedies}"


@event_text(EventCode.SERVO_HOT, Severity.WARNING)
def servo_hot(servo: str, celsius: float, register: str, limit: float) -> str:
    return (
        f"{servo} is at {celsius:.0f} deg C and cuts its torque above {limit:.0f} deg C ({register}): "
        "reduce its load"
    )


@event_text(EventCode.SERVO_HOT, Severity.INFO)
def servo_cooled(servo: str, celsius: float, register: str, limit: float) -> str:
    return f"{servo} has cooled down to {celsius:.0f} deg C; its {register} is {limit:.0f} deg C"


# Replies


@event_text(EventCode.READ_LOST, Severity.WARNING)
def reply_missed(servo: str) -> str:
    return f"{servo} did not answer"


@event_text(EventCode.READ_LOST, Severity.WARNING)
def reply_garbled(servo: str) -> str:
    return f"{servo} sent a garbled reply"


@event_text(EventCode.READ_BACK, Severity.INFO)
def servo_answers_again(servo: str, lost: int) -> str:
    return f"{servo} answers again; {'1 reply was' if lost == 1 else f'{lost} replies in a row were'} lost"


@event_text(EventCode.SERVO_LOST, Severity.ERROR)
def servo_lost(servo: str, missed: int) -> str:
    return f"{servo} missed {missed} replies in a row; it is probed once a second until it is ready"


@event_text(EventCode.SERVO_LOST, Severity.ERROR)
def servo_garbled(servo: str, remedy: str) -> str:
    return f"{servo} sends garbled or double replies: do two servos have its ID?{remedy}"


@event_text(EventCode.SERVO_LOST, Severity.ERROR)
def servo_unfit(servo: str, problems: Sequence[str]) -> str:
    return f"{servo} {unfit_clause(problems)}"


def unfit_clause(problems: Sequence[str]) -> str:
    """Return the clause `answers again, but is not ready: ...` with the problems of a servo that stays
    lost.
    """
    return f"answers again, but is not ready: it {'; it '.join(problems)}"


@event_text(EventCode.SERVO_BACK, Severity.INFO)
def servo_back_limp(servo: str) -> str:
    return f"{servo} is back and limp: it gets no goals"


@event_text(EventCode.SERVO_BACK, Severity.INFO)
def servo_back_with_goal(servo: str) -> str:
    return f"{servo} is back, with its torque and its goal as before"


@event_text(EventCode.SERVO_BACK, Severity.INFO)
def servo_back_holding(servo: str) -> str:
    return f"{servo} is back, and holds its position"


@event_text(EventCode.SERVO_REBOOTED, Severity.INFO)
def servo_rebooted_on_request(servo: str) -> str:
    return f"{servo} rebooted, as requested"


@event_text(EventCode.SERVO_REBOOTED, Severity.ERROR)
def servo_rebooted(servo: str) -> str:
    return f"{servo} rebooted: it lost power, or another program rebooted it"


@event_text(EventCode.SERVO_REBOOTED, Severity.ERROR)
def servo_reboots_repeatedly(servo: str, remedy: str) -> str:
    return (
        f"{servo} rebooted twice within a minute and stays limp; it lost power, or another program rebooted "
        f"it: {remedy}"
    )


@event_text(EventCode.SERVO_ERROR, Severity.ERROR)
def error_byte_set(servo: str, errors: str) -> str:
    return f"{servo} reports {errors}"


@event_text(EventCode.SERVO_ERROR, Severity.INFO)
def error_byte_cleared(servo: str, errors: str) -> str:
    return f"{servo} reports {errors}"


@event_text(EventCode.SERVO_ERROR, Severity.ERROR)
def hardware_error(servo: str, register: str, value: int, errors: str) -> str:
    return f"{servo} has {register} = {value}: {errors}"


@event_text(EventCode.SERVO_ERROR, Severity.WARNING)
def hardware_warning(servo: str, register: str, value: int, errors: str) -> str:
    return f"{servo} has {register} = {value}: {errors}"


# Torque and modes


@event_text(EventCode.SERVO_LIMP, Severity.ERROR)
def torque_lost(servo: str, address: int | None, value: int) -> str:
    return (
        f"{servo} has Torque Enable ({address}) = {value}: it was reset or its torque was cut; "
        "it gets no goals"
    )


@event_text(EventCode.SERVO_LIMP, Severity.ERROR)
def servo_shut_down(servo: str, register: str) -> str:
    return f"{servo} has {register} = 0: it shut down; it gets no goals until the next run"


@event_text(EventCode.SERVO_LIMP, Severity.ERROR)
def turns_lost(servo: str, joint: str) -> str:
    return (
        f"{servo} lost its turn count in a reboot: it stays limp and counts from its present position; "
        f"switch its torque on with `dxlrun torque on {joint}`"
    )


@event_text(EventCode.TORQUE_ON, Severity.INFO)
def torque_on_as_requested(servo: str) -> str:
    return f"{servo} has torque, as requested, and holds its position"


@event_text(EventCode.TORQUE_ON, Severity.WARNING)
def torque_refused(servo: str, problem: str) -> str:
    return f"{servo} gets no torque: it {problem}"


@event_text(EventCode.MODE, Severity.INFO)
def mode_entered(servo: str, mode: str) -> str:
    return f"{servo} is in {mode}"


@event_text(EventCode.MODE, Severity.ERROR)
def mode_not_entered(servo: str, problem: str, mode: str) -> str:
    return f"{servo} {problem}; it is in {mode}"


@event_text(EventCode.TORQUE_OFF, Severity.INFO)
def torque_is_off(servos: int) -> str:
    return f"torque is off on {'the servo' if servos == 1 else f'all {servos} servos'}"


@event_text(EventCode.SHUTDOWN_FAILED, Severity.ERROR)
def torque_off_not_confirmed(failure: str) -> str:
    return failure


@event_text(EventCode.SHUTDOWN_FAILED, Severity.WARNING)
def output_not_made_safe(problem: str) -> str:
    return problem


# Bus Watchdog


@event_text(EventCode.WATCHDOG, Severity.ERROR)
def watchdog_stopped_servos(silent_ms: int) -> str:
    return (
        f"no instruction for {silent_ms} ms: the Bus Watchdog has stopped the servos; "
        "dxlrun enables them again"
    )


@event_text(EventCode.WATCHDOG, Severity.ERROR)
def watchdog_not_cleared(problem: str) -> str:
    return problem


@event_text(EventCode.WATCHDOG, Severity.WARNING)
def watchdog_not_disarmed(problem: str) -> str:
    return problem


# Lines


@event_text(EventCode.PORT_LOST, Severity.ERROR)
def line_lost(error: str) -> str:
    return error


@event_text(EventCode.PORT_BACK, Severity.WARNING)
def line_back(bus: str) -> str:
    return f"bus {bus} is back; its servos are checked as after a reboot"


@event_text(EventCode.BUS_NOISE, Severity.WARNING)
def noise_received(count: int) -> str:
    return f"{counted(count, 'byte', 'bytes')} did not belong to a packet"


@event_text(EventCode.UNREQUESTED, Severity.WARNING)
def other_host_found(bus: str, packets: int) -> str:
    return (
        f"{packets} unrequested packets on bus {bus}: another program or computer sends on this line; "
        "stop it, or its commands move these servos too"
    )


@event_text(EventCode.IMPLAUSIBLE, Severity.WARNING)
def values_implausible(report: str) -> str:
    return report


@event_text(EventCode.OVERRUN, Severity.WARNING)
def idle_time_short(report: str) -> str:
    return report
