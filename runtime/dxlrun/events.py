"""Events: what happened beside the regular cycle, as the log tells it."""

from __future__ import annotations

from enum import IntEnum, unique
from typing import Protocol


@unique
class Severity(IntEnum):
    """Levels of rcl_interfaces/msg/Log, so that /rosout needs no translation."""

    INFO = 20
    WARNING = 30
    ERROR = 40
    FATAL = 50


@unique
class EventCode(IntEnum):
    """What kind of thing happened; the number is in the log and is never used for something else."""

    LOOP_STARTED = 1
    LOOP_STOPPED = 2
    OVERRUN = 3
    SCHEDULER = 4
    """A wish about scheduler, memory or collector, and whether it was granted."""
    SETUP = 10
    TORQUE_ON = 11
    TORQUE_OFF = 12
    SHUTDOWN_FAILED = 13
    REGISTER_DIFFERS = 14
    READ_LOST = 20
    """The first of a row of missed replies of one servo."""
    READ_BACK = 21
    """The servo answers again; the text counts what was missed."""
    SERVO_ERROR = 22
    """The error byte of a status packet changed."""
    SERVO_LIMP = 23
    """Torque enable reads 0 where 1 was expected: the servo was reset or its torque was cut."""
    BUS_NOISE = 24
    PORT_LOST = 25
    COMMAND = 30
    """A command was handed to a controller."""
    COMMAND_REFUSED = 31
    CONTROLLER_ACTIVATED = 32
    CONTROLLER_DEACTIVATED = 33
    CONTROLLER_FAULT = 34
    CONTROLLER_SAYS = 35
    """Free text of a controller: goal reached, goal preempted, tolerance violated."""
    GATE = 40
    """A command was clamped at the last gate; the text names joint, controller and limit."""
    GUARDIAN = 50
    RECORDER = 60
    RECORDER_GAP = 61


class EventSink(Protocol):
    """Takes events; never blocks, never raises."""

    def emit(self, code: EventCode, severity: Severity, source: str, text: str) -> None:
        """Record that `source` (a joint, a controller, a process) has something to tell."""
        ...
