"""Answers: results of client commands as data, and their texts.

The loop's process answers each command by its number, with `Completion` or `Refusal`. A command that takes
longer is answered with `Acceptance` first. The gateway forwards answers as JSON, and the Python client
decodes them to objects. Programs should use `code` and `fields`: the wording of the text may change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum, unique
from typing import TypeAlias

import msgspec

Field: TypeAlias = str | int | float | tuple[str, ...]
_MOST_BITS = 63
MOST_NAMED = 4
"""Most names of a list that a refusal's text shows; its `fields` have all of them."""


@unique
class Code(StrEnum):
    """Code of a refusal, with the format string of its text.

    A field `hint` that the format string does not contain is appended to the text.
    """

    text: str

    def __new__(cls, code: str, text: str) -> Code:
        """Create a member with its format string."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.text = text
        return member

    # the run
    RUN_ENDING = "run_ending", "the run is ending"
    NO_CYCLE = "no_cycle", "the loop has run no cycle yet; ask again"
    NO_ANSWER = (
        "no_answer",
        "the loop did not answer within {seconds:.1f} s; the request may still be executed",
    )
    # controllers
    UNKNOWN_CONTROLLER = "unknown_controller", "there is no controller {controller}"
    NAMED_TWICE = "named_twice", "{controller} is named twice; name it once"
    NOT_ACTIVE = (
        "not_active",
        "{controller} is not active; activate it by `dxlrun switch --activate {controller}`",
    )
    NOT_ACTIVE_YET = (
        "not_active_yet",
        "{controller} is not active yet; wait until its joints have changed their modes",
    )
    INACTIVE_ALREADY = "inactive_already", "{controller} is not active"
    ACTIVE_ALREADY = "active_already", "{controller} is active already"
    STILL_ACTIVE = "still_active", "{controller} is active; deactivate it first"
    JOINTS_CLAIMED = "joints_claimed", "{conflict}; deactivate one of them in the same switch"
    COMMANDED = "commanded", "{controller} is commanded by {upper}"
    NO_NEW_REFERENCES = (
        "no_new_references",
        "{controller} exports references or provides states, so it cannot be loaded; "
        "add it to the robot file and start the run again",
    )
    MODE_NOT_ENTERED = "mode_not_entered", "{controller} is not activated: {problem}"
    SWITCHED_AGAIN = "switched_again", "another switch deactivated {controller} before it was active"
    CONTROLLER_FAULT = "controller_fault", "{problem}"
    NAME_TAKEN = "name_taken", "the run already has a controller {controller}"
    TOO_MANY_CONTROLLERS = (
        "too_many_controllers",
        "the run has {most} controllers, the maximum; unload one first",
    )
    NOT_IN_PAUSE = "not_in_pause", "the loop is not paused; pause it by `dxlrun pause`"
    # goals and parameters
    UNKNOWN_TOPIC = "unknown_topic", "there is no topic {topic}; there are {topics}"
    UNKNOWN_GOAL = "unknown_goal", "there is no goal {goal}; the newest is {last}"
    GOAL_ENDED = "goal_ended", "goal {goal} has ended already: {outcome}"
    CANCELLED_ALREADY = "cancelled_already", "goal {goal} is being cancelled already"
    NO_GOAL = "no_goal", "{controller} has no goal"
    GOAL_REFUSED = "goal_refused", "{kind} of {controller}: {problem}"
    GOAL_STREAMED = "goal_streamed", "{kind} of {controller} is a goal; send it once, not in a stream"
    NOT_LIVE = "not_live", "{parameter} of {controller} cannot be changed in a run; {known}"
    UNKNOWN_PARAMETER = "unknown_parameter", "{controller} has no parameter {parameter}"
    # the loop
    PAUSED_ALREADY = "paused_already", "the loop is paused already"
    NOT_PAUSED = "not_paused", "the loop is not paused"
    RATE_OUT_OF_RANGE = (
        "rate_out_of_range",
        "{rate:g} Hz is not a possible rate of the loop; write {lowest:g} to {highest:.0f} Hz",
    )
    RATE_OVER_BUSES = "rate_over_buses", "the buses allow at most {highest:.4g} Hz"
    RATE_UNDER_WATCHDOG = "rate_under_watchdog", "the Bus Watchdog needs at least {lowest:.4g} Hz"
    RATE_UNDER_EXIT = (
        "rate_under_exit",
        "below {lowest:.2g} Hz the run cannot end within exit_timeout; choose a higher rate",
    )
    RATE_NOT_DIVIDED = (
        "rate_not_divided",
        "{rate:g} Hz is not a multiple of {controller_rate:g} Hz, the rate of controller {controller}; "
        "choose another rate",
    )
    RATE_BELOW_UPPER = (
        "rate_below_upper",
        "at {rate:g} Hz, some updates of {upper} fall between updates of {controller}; choose another rate",
    )
    # joints
    UNKNOWN_JOINT = "unknown_joint", "there is no joint {joint}"
    OMITTED = (
        "omitted",
        "this run omits {joint}; start it again without --without and without installed: false",
    )
    UNKNOWN_REGISTER = "unknown_register", "{joint}: {problem}"
    INVALID_REGISTER = "invalid_register", "{joint}: {problem}"
    REGISTER_NOT_WRITTEN = "register_not_written", "{problem}"
    REGISTER_NOT_READ = "register_not_read", "{problem}"
    JOINT_COMMANDED = (
        "joint_commanded",
        "{joint} is commanded by {controller}; deactivate {controller} first, or add --release",
    )
    JOINT_LIMP = "joint_limp", "{servo} is limp"
    JOINT_LOST = "joint_lost", "{servo} does not answer"
    HARDWARE_ERROR = "hardware_error", "{servo} has a hardware error, so its torque stays off"
    STILL_MOVING = (
        "still_moving",
        "all controllers are deactivated, but after {seconds:.1f} s {joint} still moves at "
        "{velocity:.2g} rad/s",
    )
    TORQUE_NOT_SWITCHED = "torque_not_switched", "{problem}"
    NOT_REBOOTED = "not_rebooted", "{problem}"
    # commands
    UNKNOWN_COMMAND = "unknown_command", "{controller} has no command {kind}"
    INVALID = "invalid", "{problem}"
    WRONG_QUANTITY = "wrong_quantity", "{problem}"
    WRONG_MOTION = "wrong_motion", "{problem}"
    BEYOND_LIMITS = "beyond_limits", "{kind} of {controller}: {problem}"
    TOO_SLOW = (
        "too_slow",
        "{controller} needed more than {seconds:g} s to prepare the command; send less at once",
    )
    # clients
    NOT_ALLOWED = "not_allowed", "{client} has the role {role}; the request needs the role {needed}"
    COMMANDED_BY = (
        "commanded_by",
        "{commander} commands this robot; wait until it has sent no command for {seconds:g} s, or use "
        "`dxlrun take-over`",
    )
    # requests
    UNKNOWN_PAGE = "unknown_page", "{method} {path} is not a request of this version of dxlrun"
    WRONG_METHOD = "wrong_method", "{path} does not support {method}"
    TOO_LONG = "too_long", "the request has {size} bytes, more than {most}; send less at once"
    BODY_TIMEOUT = "body_timeout", "the request did not arrive within {seconds:g} s"
    TOO_OFTEN = (
        "too_often",
        "more than {rate:g} requests a second, or too many bytes; reduce the request rate",
    )
    QUEUE_FULL = "queue_full", "the command queue is full; reduce the request rate"
    GATEWAY_FAILED = "gateway_failed", "the gateway failed: {problem}; run with --debug for details"


class Halted(msgspec.Struct, frozen=True):
    """Measurement when a `halt` command ends: which joint was fastest, and after what time."""

    seconds: float
    """Time since the loop received the `halt` command, s."""
    joint: str
    """Name of the joint with the highest speed at the end."""
    velocity: float
    """Speed of that joint, rad/s or m/s."""


class Completion(msgspec.Struct, frozen=True, tag="done"):
    """Answer: the command was executed."""

    cycle: int
    """Cycle of the loop that executed the command."""
    place: int | None = None
    """Index of a controller that was loaded, its bit in the masks of the cycles; None for other commands."""
    goals: tuple[int, ...] = ()
    """Numbers of the goals that the command started; empty if the command is not a goal."""
    value: int | None = None
    """Value of a register that was read, None if not known; None for other commands."""
    halted: Halted | None = None
    """Measurement of a halt; None for other commands."""
    deactivated: tuple[str, ...] = ()
    """Controllers that were deactivated because of a torque request or a reboot."""


class Acceptance(msgspec.Struct, frozen=True, tag="waiting"):
    """Answer: the command was accepted, but is not complete; another answer follows.

    Controllers may wait for the modes of their joints, or plan a goal. Torque requests and reboots use idle
    time.
    """

    controllers: tuple[str, ...]


class Refusal(msgspec.Struct, frozen=True, tag="refused"):
    """Answer: the command was refused. Code and fields state the reason."""

    code: Code
    fields: Mapping[str, Field] = {}

    def __post_init__(self) -> None:
        """Convert integers beyond 64 bits to text, and escape lone surrogates, such as in file names."""
        shown = {name: _writable(value) for name, value in self.fields.items()}
        msgspec.structs.force_setattr(self, "fields", shown)

    @property
    def text(self) -> str:
        """The reason of the refusal in one sentence, from the code's format string and the fields."""
        shown = {
            name: list_names(value) if isinstance(value, tuple) else value
            for name, value in self.fields.items()
        }
        sentence = self.code.text.format_map(shown)
        hint = "" if "{hint}" in self.code.text else shown.get("hint", "")
        return f"{sentence}; {hint}" if hint else sentence


Answer: TypeAlias = Completion | Acceptance | Refusal


class CommandOutcome(msgspec.Struct, frozen=True):
    """Data of the events STEERED and COMMAND_REFUSED: result of a client command."""

    kind: str
    origin: str
    refusal: Refusal | None = None
    place: int = 0
    """Number of the client command within its cycle, from 1; 0: not a client command, or not known."""


def list_names(names: Sequence[str]) -> str:
    """Return names as text for messages: all of a few, else the first ones and the number of others."""
    beyond = len(names) - MOST_NAMED
    if beyond < 2:  # "and 1 more" would not be shorter than the name
        return ", ".join(names)
    return f"{', '.join(names[:MOST_NAMED])} and {beyond} more"


def _writable(value: Field) -> Field:
    if isinstance(value, int) and value.bit_length() > _MOST_BITS:  # the longest integers of MessagePack
        return str(value)
    return value.encode(errors="backslashreplace").decode() if isinstance(value, str) else value


class AnswerMessage(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=5):
    """Record by which the loop passes an answer to the gateway."""

    number: int
    """Number of the command that is answered."""
    answer: Answer


def encode_answer(number: int, answer: Answer, most: int) -> bytes:
    """Encode an answer to a command as a record, and halve long texts and lists until it fits.

    Args:
        number: Number of the command.
        answer: The answer.
        most: Longest record, bytes.
    """
    data = msgspec.msgpack.encode(AnswerMessage(number, answer))
    while len(data) > most:
        if isinstance(answer, Acceptance):
            answer = Acceptance(answer.controllers[: len(answer.controllers) // 2])
        elif isinstance(answer, Refusal):
            fields = dict(answer.fields)
            longest = max(fields, key=lambda name: len(str(fields[name])))
            value = fields[longest]
            fields[longest] = value[: len(value) // 2] if isinstance(value, str | tuple) else 0
            answer = Refusal(answer.code, fields)
        else:
            break
        data = msgspec.msgpack.encode(AnswerMessage(number, answer))
    return data
