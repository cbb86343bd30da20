"""Recorded inputs of a replay: the plan and each cycle's inputs, validated, up to the first missing data."""

from __future__ import annotations

import itertools
from dataclasses import field
from importlib import metadata

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun import CONTRACT_VERSION, Log, LogError
from dxlrun.tooling.logs import IDENTITY_NAME, UNREADABLE, changed_code
from dxlrun.tooling.plans import LoopPlan, PolicyPlan, decode_plan
from dxlrun.tooling.records import EventCode, Severity
from dxlrun.tooling.robots import PlugIns
from dxlrun.tooling.runs import RunInputs, kept_states_of
from dxlrun_analysis.conduct.client_commands import client_commands, policy_begun, unlogged_commands

PLAN = "plan.json"
_LIBRARIES = ("dxlrun", "numpy")  # Another version of these libraries can change a command


class _PolicyStart(msgspec.Struct):
    """Data of the logged command with which a policy begins."""

    policy: str


class RecordedPlan(msgspec.Struct, frozen=True):
    """Fields of a log's plan that a replay needs, without those about the buses."""

    robot: str
    loop: LoopPlan
    source_file: str
    source_text: str
    arguments: dict[str, str]
    included: dict[str, str] = field(default_factory=dict)
    omitted: tuple[str, ...] = ()


class ReplayDifference(msgspec.Struct, frozen=True):
    """One value that differs between run and replay."""

    cycle: int
    time_s: float  # Time of the cycle's wake-up, since the loop's first deadline
    what: str
    """`command of the position`, `goal of the velocity ...`, `reference arm_pid/j0/position`, `active`."""
    joint: str | None
    """Joint of the value; None for a message, or if a controller was active in only one of the two."""
    controller: str | None  # Controller that claims the joint or commands the reference; None without one
    recorded: str  # Shortest decimal number with these bits; if it is not finite, also the bits
    replayed: str


class RecordedInputs(RunInputs, frozen=True, eq=False):
    """Inputs of a recorded run for its replay, with the plan, and why some cycles cannot be compared."""

    plan: RecordedPlan
    stopped: str  # Reason why some cycles cannot be compared; empty if all can

    def difference(  # noqa: PLR0917  what a difference is made of
        self, index: int, what: str, joint: str | None, controller: str | None, recorded: str, replayed: str
    ) -> ReplayDifference:
        """Return the record of a difference in the cycle with this index; -1: before the first cycle."""
        cycle = self.activation if index < 0 else self.log.cycles[index]
        time_s = (int(cycle["woken_ns"]) - self.start_ns) * 1e-9
        return ReplayDifference(int(cycle["cycle"]), time_s, what, joint, controller, recorded, replayed)


def recorded(log: Log) -> RecordedInputs:
    """Validate and return the inputs of a replay; `log` is the result of `overview`.

    Raises:
        LogError: The log has no usable inputs.
    """
    plan = _plan(log)
    activation = _beginning(log)
    start_ns = int(activation["scheduled_ns"])
    if plan.loop.schedule == "absolute":
        _check_times(log, start_ns, plan.loop.period_ns)
    else:
        _check_sequence(log, start_ns, plan.loop.period_ns)
    _check_commands(log)
    end, ends, stopped = _until_hole(log)
    if not end:
        raise LogError(f"{log.path}: {stopped}")
    return RecordedInputs(
        log=log,
        plan=plan,
        loop=_loop(log, plan.loop),
        activation=activation,
        start_ns=start_ns,
        steered=client_commands(log),
        end=end,
        ends=ends,
        kept=kept_states_of(log),
        stopped=stopped,
    )


def _beginning(log: Log) -> np.void:
    """Return the activation record of a log: states and goals when the controllers were activated.

    Raises:
        LogError: The log begins later, so the state of its controllers is unknown.
    """
    path, cycles = log.path, log.cycles
    if not len(cycles):
        raise LogError(f"{path}: nothing to replay: the loop finished no cycle, or the log lost all cycles")
    if log.activation is None or int(cycles["cycle"][0]) != int(cycles["skipped"][0]):
        begins = f"begins with cycle {int(cycles['cycle'][0])}"
        raise LogError(
            f"{path}: a replay needs the start of the run, but this log "
            f"{begins if int(cycles['cycle'][0]) else 'has no /activation'}; give the directory with all "
            "parts of the log"
        )
    activation: np.void = log.activation[0]
    return activation


def version_remarks(inputs: RecordedInputs, plugins: PlugIns) -> tuple[str, ...]:
    """Return a sentence for each of dxlrun, numpy and controller types with another version than then."""
    then = inputs.log.metadata.get("versions", {})
    sentences = []
    for name in _LIBRARIES:
        now = metadata.version(name)
        if then.get(name, now) != now:
            sentences.append(f"{name} has version {then[name]} in the run and {now} in the replay")
    for was in sorted({(plan.type, plan.distribution) for plan in inputs.plan.loop.controllers}):
        offer = plugins.controllers.get(was[0])
        if offer is not None and offer.distribution != was[1]:
            sentences.append(
                f"the controller type {was[0]} came from {was[1]} in the run and comes from "
                f"{offer.distribution} in the replay"
            )
    return tuple(sentences)


def code_remarks(inputs: RecordedInputs) -> tuple[str, ...]:
    """Return a sentence for each of dxlrun and the controllers' plug-ins whose files have changed."""
    publishers = [plan.distribution for plan in inputs.plan.loop.controllers]
    return changed_code(inputs.log.metadata.get(IDENTITY_NAME, {}), publishers)


def _plan(log: Log) -> RecordedPlan:
    contract = log.metadata.get("versions", {}).get("contract", str(CONTRACT_VERSION))
    if contract not in map(str, range(1, CONTRACT_VERSION + 1)):
        raise LogError(
            f"{log.path}: the controllers of the run have contract {contract}, this dxlrun has contract "
            f"{CONTRACT_VERSION}; replay the log with dxlrun {_version(log)}"
        )
    data = log.attachments.get(PLAN)
    if data is None:
        raise LogError(f"{log.path}: the log has no attachment {PLAN}, so its controllers are unknown")
    try:
        plan = decode_plan(data, RecordedPlan)
    except UNREADABLE as error:
        raise LogError(
            f"{log.path}: this dxlrun cannot read the plan in the log ({error}); replay the log with "
            f"dxlrun {_version(log)}"
        ) from error
    if tuple(joint.name for joint in plan.loop.joints) != log.joints:
        raise LogError(f"{log.path}: the log is damaged: plan and cycles differ in joints")
    if tuple(controller.name for controller in plan.loop.controllers) != tuple(
        controller.name for controller in log.controllers
    ):
        raise LogError(f"{log.path}: the log is damaged: plan and cycles differ in controllers")
    if plan.loop.references != log.header.references:
        raise LogError(f"{log.path}: the log is damaged: plan and cycles differ in references")
    if plan.loop.source_states != log.header.sources:
        raise LogError(f"{log.path}: the log is damaged: plan and cycles differ in devices and sensors")
    _check_controllers(log, plan.loop)
    return plan


def _check_controllers(log: Log, loop: LoopPlan) -> None:
    """Raise LogError if a controller of the plan has an unknown joint, or a rate divider below 1."""
    for controller in loop.controllers:
        unknown = set(controller.joints) - set(log.joints)
        if unknown or controller.every < 1:
            what = f"the unknown joint {min(unknown)}" if unknown else f"the rate divider {controller.every}"
            raise LogError(
                f"{log.path}: the log is damaged: controller {controller.name} of the plan has {what}"
            )


def _version(log: Log) -> str:
    return f"version {log.metadata.get('versions', {}).get('dxlrun', 'unknown')}"


def _check_times(log: Log, start_ns: int, period_ns: int) -> None:
    """Raise LogError if the cycles' times contradict a periodic loop; a replay might never end.

    The time between two deadlines is the difference of their numbers times the period. The period changes
    only in a cycle that executed a change of the rate. Across missing cycles it is unknown.
    """
    cycles = log.cycles
    number, due, woken = cycles["cycle"], cycles["scheduled_ns"], cycles["woken_ns"]
    passed = np.diff(number, prepend=0)
    elapsed_ns = np.diff(due, prepend=start_ns)
    changes = [command.cycle for command in log.commands if command.for_loop and command.kind == "rate"]
    begins = np.unique(np.searchsorted(number, changes, side="right"))
    begins = begins[begins < len(number)]
    unknown = begins[passed[begins] != 1 + cycles["skipped"][begins]]
    period = np.full(len(number), period_ns)
    for first, end in itertools.pairwise([*np.union1d(begins, unknown + 1).tolist(), len(number)]):
        period[first:end] = elapsed_ns[first] // max(int(passed[first]), 1) if first < end else 0
    uneven = elapsed_ns != passed * period
    uneven[unknown] = False
    wrong = (woken < due) | (cycles["read_ns"] < woken) | uneven
    wrong[1:] |= passed[1:] <= 0
    _refuse_wrong(log, wrong)


def _check_sequence(log: Log, start_ns: int, period_ns: int) -> None:
    """Raise LogError if the cycles' times contradict a sequential schedule: a deadline is a period after
    the preceding wake-up."""
    cycles = log.cycles
    number, due, woken = cycles["cycle"], cycles["scheduled_ns"], cycles["woken_ns"]
    before = np.roll(woken, 1)
    before[0] = start_ns - period_ns
    lost = np.diff(number, prepend=-1) != 1  # The begin of a lost cycle is unknown
    _refuse_wrong(log, (woken < due) | (cycles["read_ns"] < woken) | (due != before + period_ns) & ~lost)


def _refuse_wrong(log: Log, wrong: NDArray[np.bool_]) -> None:
    if wrong.any():
        cycle = int(log.cycles["cycle"][int(np.argmax(wrong))])
        raise LogError(f"{log.path}: the times of cycle {cycle} contradict its number: the log is damaged")


def _check_commands(log: Log) -> None:
    """Raise LogError if a command has another time than the wake-up of the cycle that executed it."""
    policy = policy_begun(log)
    for command in log.commands:
        at = _index_of(log, command.cycle)
        if command is not policy and at is not None and int(log.cycles["woken_ns"][at]) != command.t_ns:
            raise LogError(
                f"{log.path}: the log is damaged: a command ({command.kind}) and its cycle "
                f"{command.cycle} have different times"
            )


def _index_of(log: Log, cycle: int) -> int | None:
    """Return the index of a cycle by its number, or None if the log does not have it."""
    number = log.cycles["cycle"]
    at = int(np.searchsorted(number, cycle))
    return at if at < len(number) and int(number[at]) == cycle else None


def _until_hole(log: Log) -> tuple[int, int, str]:
    """Return the number of cycles that can be compared, the index of the first cycle of a policy, and why
    later cycles cannot be compared.

    After a missing cycle or command, the state of the controllers is unknown.
    """
    end, ends, stopped = _until_policy(log, len(log.cycles))
    hole, why = _first_hole(log)
    if hole >= end:
        return end, ends, stopped
    number = int(log.cycles["cycle"][hole])
    lost = f"the state of the controllers is unknown from cycle {number} on, so the comparison ends"
    return hole, ends, f"{why}; {lost}"


def _first_hole(log: Log) -> tuple[int, str]:
    """Return the index of the first cycle before or in which cycles or commands are missing in the log, and
    the reason as text.

    Without missing data, the index is the number of cycles.
    """
    cycles = log.cycles
    number = cycles["cycle"]
    gaps = [event.text for event in log.events if event.code == EventCode.RECORDER_GAP]
    because = f" ({gaps[0]})" if gaps else ""
    held = np.zeros(len(cycles), dtype=np.int64)
    for command in log.commands:
        if not command.for_loop and (there := _index_of(log, command.cycle)) is not None:
            held[there] += 1
    missing = held < cycles["command_count"]
    missing[np.isin(number, unlogged_commands(log))] = True
    gap = np.zeros(len(cycles), np.bool_)
    gap[1:] = number[1:] != number[:-1] + 1 + cycles["skipped"][1:]
    if not (gap | missing).any():
        return len(cycles), ""
    at = int(np.argmax(gap | missing))
    if gap[at]:
        first, last = int(number[at - 1]) + 1, int(number[at]) - 1
        return at, f"the log lacks cycles between {first} and {last}{because}"
    return at, f"the log lacks a command of cycle {int(number[at])}{because}"


def _until_policy(log: Log, usable: int) -> tuple[int, int, str]:
    """Return the number of usable cycles, the number of those before a policy began, and why later cycles
    cannot be compared.

    A cycle in which a bus failed is not in the log, although the time of the next cycle depends on it.
    """
    cycles, policy = log.cycles, policy_begun(log)
    if policy is None:
        begins = (EventCode.POLICY, "loop", Severity.INFO)  # that a group is limp is an error
        begun = [event.t_ns for event in log.events if (event.code, event.source, event.severity) == begins]
        ends = int(np.searchsorted(cycles["woken_ns"], begun[0], side="right")) if begun else usable
        if ends >= usable:
            return usable, usable, ""
        return ends, ends, f"the log lacks the start of a policy after cycle {ends - 1}"
    ends = min(usable, int(np.searchsorted(cycles["cycle"], policy.cycle)))
    if 0 < ends < usable:
        passed_ns = int(cycles["woken_ns"][ends]) - int(cycles["woken_ns"][ends - 1])
        if policy.t_ns != int(cycles["woken_ns"][ends - 1]) and int(cycles["period_ns"][ends]) < passed_ns:
            return ends, ends, f"a bus failed in cycle {policy.cycle}; later cycles are not compared"
    return usable, ends, ""


def _loop(log: Log, plan: LoopPlan) -> LoopPlan:
    """Return the loop's plan for the replay, with the commands that the run executed. Time and signals do
    not end it, because their effects are in the log."""
    taken = {command.planned for command in log.commands if command.planned >= 0}
    if beyond := sorted(number for number in taken if number >= len(plan.commands)):
        cycle = next(command.cycle for command in log.commands if command.planned == beyond[0])
        raise LogError(f"{log.path}: the plan in the log lacks a command of cycle {cycle}")
    return replace(
        plan,
        commands=tuple(command for number, command in enumerate(plan.commands) if number in taken),
        end_ns=None,
        ends_with_goals=False,
        overrun="skip",
        policies=_policies(log, plan.policies),
    )


def _policies(log: Log, policies: PolicyPlan) -> PolicyPlan:
    """Return the policies so that the policy that began in the run begins after the replay's last cycle."""
    begun = policy_begun(log)
    if begun is None:
        return policies
    try:
        policy = policies.named(msgspec.json.decode(begun.data, type=_PolicyStart).policy)
    except (*UNREADABLE, KeyError) as error:
        raise LogError(f"{log.path}: the policy at the end of the run cannot be read: {error}") from error
    return replace(policies, on_exit=policy)
