"""Texts of the control room: the events of loop, controllers, goals, gate and policies.

Each row has the code, the severity and the fields of one event. Refusals are in `channels/answers.py`.
"""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.channels.event_records import EventCode, Severity, event_text
from dxlrun.errors import counted

# Loop


@event_text(EventCode.LOOP_STARTED, Severity.INFO)
def loop_started(period_ns: int) -> str:
    return f"loop started, period {period_ns / 1e6:g} ms"


@event_text(EventCode.LOOP_STOPPED, Severity.INFO)
def loop_stopped(reason: str, cycles: int, skipped: int, detail: str) -> str:
    return _end(reason, cycles, skipped, detail)


@event_text(EventCode.LOOP_STOPPED, Severity.FATAL)
def loop_failed(cycles: int, skipped: int, detail: str) -> str:
    return _end("fault", cycles, skipped, detail)


def _end(reason: str, cycles: int, skipped: int, detail: str) -> str:
    text = f"loop {reason} after {counted(cycles, 'cycle', 'cycles')}"
    return f"{text}, {counted(skipped, 'period', 'periods')} skipped{f': {detail}' if detail else ''}"


@event_text(EventCode.OVERRUN, Severity.WARNING)
def cycle_overran(cycle: int, late_ns: int, skipped: int, catches_up: bool) -> str:
    return (
        f"cycle {cycle} ended {late_ns / 1e6:.3f} ms after its deadline; "
        f"{counted(skipped, 'period', 'periods')} skipped"
        f"{', the next cycle follows at once' if catches_up else ''}"
    )


@event_text(EventCode.OVERRUN, Severity.ERROR)
def overrun_hook_dismissed(problem: str) -> str:
    return f"the hook dxlrun_overrun {problem}; it is not called again in this run"


@event_text(EventCode.SCHEDULER, Severity.INFO)
def request_granted(result: str) -> str:
    return result


@event_text(EventCode.SCHEDULER, Severity.WARNING)
def request_denied(result: str) -> str:
    return result


# Policies


@event_text(EventCode.POLICY, Severity.INFO)
def policy_begins(policy: str, steps: str) -> str:
    return f"{policy}: {steps}"


@event_text(EventCode.POLICY, Severity.WARNING)
def policy_unfinished(policy: str, step: str, last: str) -> str:
    return f"{policy}: {step}; now {last}"


@event_text(EventCode.POLICY, Severity.WARNING)
def policy_keeps_torque(policy: str) -> str:
    return f"{policy}: torque stays on"


@event_text(EventCode.POLICY, Severity.WARNING)
def controller_held(until: str) -> str:
    return f"is held until {until}"


@event_text(EventCode.POLICY, Severity.INFO)
def controller_resumes(because: str) -> str:
    return f"resumes: {because}"


@event_text(EventCode.POLICY, Severity.INFO)
def controller_restarted(because: str) -> str:
    return f"restarted at the measured positions: {because}"


@event_text(EventCode.STALE_COMMAND, Severity.WARNING)
def pause_expired(consequence: str) -> str:
    return f"{PAUSE_EXPIRED}; {consequence}"


@event_text(EventCode.STALE_COMMAND, Severity.WARNING)
def stream_expired(consequence: str) -> str:
    return f"the stream of commands ended; {consequence}"


# Commands


@event_text(EventCode.COMMAND, Severity.INFO)
def command_accepted(kind: str, origin: str) -> str:
    return f"{kind} from {origin}"


@event_text(EventCode.STEERED, Severity.INFO)
def loop_steered(command: str, origin: str) -> str:
    return f"{command} from {origin}"


@event_text(EventCode.PARAMETERS, Severity.INFO)
def parameters_changed(values: str) -> str:
    return values


@event_text(EventCode.COMMAND_REFUSED, Severity.WARNING)
def command_refused(kind: str, origin: str, refusal: str) -> str:
    return f"{kind} from {origin} refused: {refusal}"


@event_text(EventCode.COMMAND_REFUSED, Severity.WARNING)
def takeover_refused(controllers: str, refusal: str, because: str) -> str:
    return f"takeover by {controllers} refused: {refusal} (requested because: {because})"


@event_text(EventCode.COMMAND_REFUSED, Severity.WARNING)
def controller_not_activated(controller: str, problem: str) -> str:
    return f"{controller} is not activated: {problem}"


@event_text(EventCode.COMMAND_REFUSED, Severity.WARNING)
def fallback_refused(controller: str, refusal: str) -> str:
    return f"{controller} cannot take over: {refusal}"


# Controllers


@event_text(EventCode.CONTROLLER_LOADED, Severity.INFO)
def controller_loaded(duration_ns: int) -> str:
    return f"loaded in {duration_ns / 1e6:.1f} ms, with the loop paused"


@event_text(EventCode.CONTROLLER_LOADED, Severity.INFO)
def controller_unloaded(duration_ns: int) -> str:
    return f"unloaded in {duration_ns / 1e6:.1f} ms, with the loop paused"


@event_text(EventCode.CONTROLLER_ACTIVATED, Severity.INFO)
def controller_activated() -> str:
    return "active"


@event_text(EventCode.CONTROLLER_DEACTIVATED, Severity.INFO)
def controller_deactivated() -> str:
    return "inactive"


@event_text(EventCode.MODE, Severity.INFO)
def controller_waits_for_modes() -> str:
    return "waits for the mode changes of its joints"


@event_text(EventCode.CONTROLLER_FAULT, Severity.ERROR)
def controller_failed(fault: str, notes: Sequence[str]) -> str:
    return "\n".join([fault, *notes])


@event_text(EventCode.CONTROLLER_SAYS, Severity.INFO)
def controller_says(text: str) -> str:
    return text


@event_text(EventCode.CONTROLLER_SAYS, Severity.WARNING)
def controller_warns(text: str) -> str:
    return text


@event_text(EventCode.TAKEOVER, Severity.WARNING)
def controllers_take_over(names: Sequence[str], replaced: Sequence[str], because: str) -> str:
    verb = "take" if len(names) > 1 else "takes"
    instead = f" from {', '.join(replaced)}" if replaced else ""
    return f"{' and '.join(names)} {verb} over{instead}: {because}"


@event_text(EventCode.KEPT, Severity.INFO)
def kept_state_used(size: int, file: str) -> str:
    return f"starts with its kept state of {size} bytes ({file})"


@event_text(EventCode.KEPT, Severity.WARNING)
def kept_state_unusable(problem: str, file: str) -> str:
    return f"starts without its kept state: {problem} ({file})"


# Goals


@event_text(EventCode.GOAL_ACCEPTED, Severity.INFO)
def goal_accepted(goal: int, kind: str, origin: str) -> str:
    return f"goal {goal}: {kind} from {origin}"


@event_text(EventCode.GOAL_ENDED, Severity.INFO)
def goal_ended(goal: int, outcome: str, reason: str) -> str:
    return f"goal {goal} {outcome}{f': {reason}' if reason else ''}"


@event_text(EventCode.GOAL_ENDED, Severity.WARNING)
def goal_failed(goal: int, outcome: str, reason: str) -> str:
    return f"goal {goal} {outcome}{f': {reason}' if reason else ''}"


# Gate: `clamp` has the verb of the sentence, such as `lowered to the upper position limit`.


@event_text(EventCode.GATE, Severity.WARNING)
def goal_clamped(joint: str, controller: str, clamp: str) -> str:
    return f"{joint}{f', {controller}' if controller else ''}: goal {clamp}"


@event_text(EventCode.GATE, Severity.INFO)
def clamp_ended(joint: str, clamp: str, lasted_ns: int) -> str:
    return f"{joint}: goal {clamp}; this ended after {lasted_ns * 1e-9:.1f} s"


@event_text(EventCode.GATE, Severity.WARNING)
def source_command_clamped(source: str, command: str, value: float, lowest: float, highest: float) -> str:
    return f"{source}: {command} = {value:.6g} is clamped to its range {lowest:.6g}..{highest:.6g}"


@event_text(EventCode.SERVO_LIMITS, Severity.INFO)
def servo_limits_found(joint: str, limits: str) -> str:
    return f"{joint}: {limits}"


@event_text(EventCode.SERVO_LIMITS, Severity.WARNING)
def servo_limits_tighter_than_file(joint: str, limits: str) -> str:
    return f"{joint}: {limits}"


@event_text(EventCode.SERVO_LIMITS, Severity.INFO)
def servo_limits_gone(joint: str) -> str:
    return f"{joint}: servo registers no longer limit goals"


# Consequences of commands that do not come any more

PAUSE_EXPIRED = "no client ended the pause"
