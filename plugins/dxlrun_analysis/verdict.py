"""The verdict: whether a run was good, and what a person wants to know first, in sentences.

The one set of rules: the terminal at the end of a run, `analyze`, its page and its JSON all use it, and the
exit code is 1 where a run was not good. The most severe finding comes first. A run was not good when

- a line or a servo was lost, a servo rebooted or lost its torque, the loop never ran a cycle, or another
  process of the run failed;
- a joint's state was invalid in more than 1 % of the cycles, and in three at least; those of a reboot that a
  client requested do not count;
- more periods were skipped than the robot file tolerates (`loop: {tolerated_skips: ...}`), of two seconds at
  least;
- an error was logged, a servo reported one, or the log is not whole.

All else is reported and tolerated: a lost packet is data. Wake-ups are *rough* when more than 1 % are later
than 150 us (M. A. Araujo, UFU 2017, measured 1.74 % at 1 kHz under stress on a stock kernel, none on a
real-time kernel). Replies are *late* when the adapter adds 2 ms more than the plan expects.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import InitVar, dataclass, field, replace

from dxlrun.channels.events import EventCode, EventGroup, Severity
from dxlrun.errors import counted
from dxlrun.output.table import microseconds
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.causes.rules import cause_findings
from dxlrun_analysis.conduct.steering import Act, Pause
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.robot_line import robot_line
from dxlrun_analysis.servos.traffic import ServoTraffic
from dxlrun_analysis.tally import RealTime, RunTotals

INVALID_SHARE = 0.01
"""More invalid states of a joint than this, and the run was not good."""
_FEW_INVALID = 2
"""So few are tolerated however short the run: a servo that misses three replies in a row is lost."""
_SHORT_RUN_S = 2.0
"""A shorter run may skip as much as one of this: a machine that stalls once is not overloaded."""
ROUGH_SHARE = 0.01
_MOST_NAMED = 3
_KINDS = {
    "switch": "switch",
    "rate": "change of the rate",
    "halt": "halt",
    "pause": "pause",
    "load": "controller loaded",
    "unload": "controller unloaded",
    "register": "register written",
    "get": "register read",
    "torque": "torque request",
    "reboot": "reboot request",
    "stop": "stop",
}
_MANY = {
    "switch": "switches",
    "change of the rate": "changes of the rate",
    "controller loaded": "controllers loaded",
    "controller unloaded": "controllers unloaded",
    "register written": "registers written",
    "register read": "registers read",
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the robot did, then findings, the most severe first; `good`: nothing that a run may not have."""

    good: bool = field(init=False)
    word: str = field(init=False)
    """The verdict in words: good; good, with fallbacks; not good."""
    sentences: tuple[str, ...] = field(init=False)
    """Of the findings, with their remedies."""
    findings: tuple[Finding, ...] = ()
    fallbacks: InitVar[bool] = False
    """Controllers took over for others."""

    def __post_init__(self, fallbacks: bool) -> None:
        ordered = sorted(self.findings, key=lambda finding: finding.order)
        object.__setattr__(self, "findings", tuple(ordered))
        object.__setattr__(self, "good", all(finding.rank >= Rank.CAUSE for finding in ordered))
        word = "not good" if not self.good else "good, with fallbacks" if fallbacks else "good"
        object.__setattr__(self, "word", word)
        object.__setattr__(self, "sentences", tuple(finding.line for finding in ordered))


def judge(totals: RunTotals) -> Verdict:
    """Return whether a run was good, and what was and what was not."""
    found = (
        *(
            Finding("run_failed", "", f"The run failed: {failed}.", rank=Rank.NEVER_RAN)
            for failed in totals.failures
        ),
        *totals.findings,
        *_robot(totals),
        *_loop(totals),
        *_lines(totals),
        *_whole_buses(totals),
        *_lost_servos(totals),
        *_lost_devices(totals),
        *_invalid(totals),
        *_implausible(totals),
        *_causes(totals),
        *_slow(totals),
        *_rough(totals),
        *_steered(totals.acts, totals.pauses),
        *_silent(totals),
        *_errors(totals.servos),
        *_events(totals),
        *_log(totals),
    )
    ranked = _explaining(totals, _one_accused(totals, _busy(totals, found)))
    judged = tuple(replace(finding, remedy=_remedy(finding, totals)) for finding in ranked)
    fallbacks = bool(totals.conduct.takeovers)
    verdict = Verdict(judged, fallbacks)
    return Verdict((robot_line(totals, verdict.word, verdict.findings), *judged), fallbacks)


# What holds for the findings of all rules

_REPLIES = (
    *("late_replies_everywhere", "power_lost", "latency_timer", "late_replies", "another_host"),
    *("broken_replies", "return_delay", "slow_servo", "noise", "loose_cable", "lossy_servo", "shared_cable"),
    *("lossy_line", "silent_bus"),
)
"""Codes of what is wrong with replies, the most direct evidence first."""
_WEAK = ("noise", "lossy_line", "silent_bus")
"""Those that only say that bytes belong to no packet, or that replies are missing."""
_SPOILT = ("power_lost", "another_host", "noise", "broken_replies")
_OF_TIME = frozenset(
    (
        *(code for code in _REPLIES if code not in _SPOILT),
        *("missing_replies", "servo_lost", "device_lost", "slow_writes"),
        *("late_wake_ups", "rough_wake_ups", "busy_machine", "own_work", "long_cycle"),
    )
)
"""Codes of what a machine that is too busy does too; also to the replies of a real servo, which wait for the
host in its driver."""
_FACTS = (Rank.SERVO, Rank.SHARE, Rank.ERROR)
_MARGIN = 0.1
"""A busy machine makes no greater a share of the replies late than so much above its share of the run."""


def _busy(totals: RunTotals, found: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Put a machine that was too busy (see `MachineLoad`) in place of what it explains.

    It explains late and missing replies and wake-ups, but not more late ones than it had busy seconds, and
    simulated servos and devices that were lost. What makes a run not good is told all the same, without a
    remedy.
    """
    load = totals.causes.load
    explained = [finding for finding in found if _is_explained(finding, totals)]
    if not load.share or not explained:
        return found
    kept = tuple(
        replace(finding, remedy="") if finding in explained else finding
        for finding in found
        if finding not in explained or finding.rank in _FACTS
    )
    failed = any(finding.rank == Rank.SERVO for finding in explained)
    simulated = any(bus.simulated for bus in totals.plan.buses)
    ends = "End other programs" + (
        ", or use --virtual: simulated servos answer late too." if simulated else "."
    )
    helps = ends if totals.real_time.granted else f"{ends} {_wake_up_remedy(totals.real_time)}"
    sentence = f"The machine was too busy: {load.text}."
    rank = Rank.SERVO_CAUSE if failed else Rank.CAUSE
    return (Finding("busy_machine", "machine", sentence, helps, rank, 3.0), *kept)


def _is_explained(finding: Finding, totals: RunTotals) -> bool:
    if finding.code in ("servo_lost", "device_lost", "silent_bus") and not totals.plan.is_simulated(
        finding.subject
    ):
        return False
    late = finding.code in ("latency_timer", "late_replies", "slow_servo", "return_delay")
    return finding.code in _OF_TIME and not (late and finding.share > totals.causes.load.share + _MARGIN)


def _one_accused(totals: RunTotals, found: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Leave one finding for what is wrong with the replies of a part: the one with the most direct evidence.

    What holds for the machine or a whole bus stands for all its servos, and what only says that replies are
    missing goes where anything else is known of its bus. Servos that failed, or followed worse, are then not
    accused besides.
    """
    bus_of = {_subject(servo): servo.bus for servo in totals.servos}
    named = sorted((one for one in found if one.code in _REPLIES), key=lambda one: _REPLIES.index(one.code))
    kept: list[Finding] = []
    for one in named:
        bus = bus_of.get(one.subject, one.subject)
        whole = {"machine", bus, one.subject}
        same_bus = {other.subject for other in kept if bus_of.get(other.subject, other.subject) == bus}
        if not any(other.subject in whole for other in kept) and not (one.code in _WEAK and same_bus):
            kept.append(one)
    whole = {one.subject for one in kept if one.subject not in bus_of}
    whole |= {one.subject for one in found if one.code in ("busy_machine", "bus_lost")}
    return tuple(
        replace(one, remedy="")
        if one.code in (*_CODES.values(), *_MOVES_WORSE)
        and {"machine", bus_of.get(one.subject, one.subject)} & whole
        else one
        for one in found
        if one.code not in _REPLIES or one in kept
    )


def _remedy(finding: Finding, totals: RunTotals) -> str:
    """Return what to do about a finding: the one place that knows whether what it accuses is simulated.

    Of a simulated part there is nothing to check or to exchange, whatever its rule proposes for a real one.
    """
    part = finding.code in _REPLIES or finding.subject not in _NO_PARTS
    if not finding.remedy or not part or not totals.plan.is_simulated(finding.subject):
        return finding.remedy
    if finding.code in _OF_TIME and not totals.virtual:
        return (
            "Its servos are simulated: a fault was injected, or the machine was too busy for them; end other "
            "programs, or use --virtual."
        )
    return "It is simulated: look at the faults that were injected, and at what the motion asks of it."


_MOVES_WORSE = ("error_grew", "joint_shakes")
_NO_PARTS = ("", "loop", "machine", "log")


def _explaining(totals: RunTotals, found: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Put each cause before what it explains: a servo that failed, or states, periods and replies."""
    failed = {group.source for group in _of(totals.events, *_HURTS)}
    failed |= {finding.subject for finding in found if finding.rank == Rank.SERVO}
    failed |= {servo.bus for servo in totals.servos if servo.joint in failed}
    worse = any(finding.rank in (Rank.SHARE, Rank.ERROR) for finding in found)
    bus_of = {_subject(servo): servo.bus for servo in totals.servos}
    # where replies are spoilt, goals wait for a torque that is known again, and other joints follow worse
    behind = {bus_of.get(one.subject, one.subject) for one in found if one.code in _MOVES_WORSE}
    return tuple(
        finding
        if finding.rank != Rank.CAUSE
        else replace(finding, rank=Rank.SERVO_CAUSE)
        if finding.subject in failed
        or (failed and finding.code == "late_replies_everywhere")
        or (finding.code in _SPOILT and bus_of.get(finding.subject, finding.subject) in behind)
        else replace(finding, rank=Rank.SHARE_CAUSE)
        if worse
        else finding
        for finding in found
    )


def _robot(totals: RunTotals) -> Iterable[Finding]:
    """Report a robot that ended lying, and goals of a played motion that were missed."""
    if totals.conduct.lies:
        turned = totals.conduct.turned_rad
        how = "its fall_reflex had others take over" if turned is None else "gravity is "
        how += "" if turned is None else f"{math.degrees(turned):.0f} deg from where it was at the start"
        yield Finding("fell", "", f"The robot fell, and lies: {how}.", rank=Rank.SERVO, share=1.0)
    planned = {one.origin for one in totals.plan.loop.commands}
    for report in totals.conduct.failed:
        if report.status == "missed" and report.origin in planned:
            sentence = f"{report.controller} missed the goal of its {report.kind}: {report.text}."
            yield Finding("goal_missed", report.joint or report.controller, sentence, rank=Rank.ERROR)


def _loop(totals: RunTotals) -> Iterable[Finding]:
    account, wake_ups = totals.periods, totals.latency
    if not account.records:
        none = "The log has no cycle of the loop" if totals.damage else "The loop never ran a cycle"
        yield Finding("never_ran", "loop", f"{none}.", rank=Rank.NEVER_RAN)
        return
    share = account.skipped / account.elapsed
    judged = max(account.elapsed, _SHORT_RUN_S * account.rate_hz)
    tolerable = account.skipped <= totals.plan.loop.tolerated_skips * judged
    kept = "kept" if tolerable else "did not keep"
    wake_up = f", worst wake-up {microseconds(wake_ups.max_us)} late" if wake_ups is not None else ""
    wake_up = ", on virtual time" if totals.virtual else wake_up
    elapsed = counted(account.elapsed, "period", "periods")
    if totals.plan.loop.schedule == "sequential":
        took = f"{elapsed} of {account.rates} took {account.seconds:.3f} s"
        yield Finding("sequential", "", f"Cycles followed each other, not the clock: {took}{wake_up}.")
        return
    tolerated = f"{totals.plan.loop.tolerated_skips * 100:.4g}% tolerated"
    if judged > account.elapsed:
        tolerated = f"{totals.plan.loop.tolerated_skips * judged:.0f} tolerated in a short run"
    shares = f" ({share:.2%}; {tolerated})" if account.skipped else ""
    sentence = f"The loop {kept} {account.rates}: {account.skipped} of {elapsed} skipped{shares}{wake_up}."
    if tolerable:
        yield Finding("rate_kept", "", sentence)
    else:
        yield Finding("skipped_periods", "loop", sentence, rank=Rank.SHARE, share=share)


def _causes(totals: RunTotals) -> Iterable[Finding]:
    """Report what made cycles too long; of a bus only where nothing else explains its late replies."""
    if totals.plan.loop.schedule == "sequential":
        return
    explained = {finding.subject for finding in totals.findings if finding.rank == Rank.CAUSE}
    explained |= {servo.bus for servo in totals.servos if _subject(servo) in explained}
    bus_of = {_subject(servo): servo.bus for servo in totals.servos}
    for finding in cause_findings(totals.causes, _wake_up_remedy(totals.real_time)):
        if bus_of.get(finding.subject, finding.subject) not in explained:
            yield finding


def _slow(totals: RunTotals) -> Iterable[Finding]:
    """Report the longest step of the cycle that exceeds its period most."""
    slowest = totals.slowest
    if slowest is None:
        return
    steps = ((slowest.read_ns, "read"), (slowest.update_ns, "update"), (slowest.write_ns, "write"))
    longest_ns, name = max(steps)
    yield Finding(
        "long_cycle",
        "loop",
        f"A cycle took up to {microseconds(slowest.lasted_ns / 1e3)}, longer than its period of "
        f"{microseconds(slowest.period_ns / 1e3)}; its {name} took {microseconds(longest_ns / 1e3)}"
        f"{_why(totals.causes)}.",
    )


def _why(causes: Causes) -> str:
    """Return the main cause of the cycle that took longest, as the end of a sentence."""
    longest = max(causes.worst, key=lambda one: one.written_us - one.woken_us, default=None)
    if longest is None or longest.written_us - longest.woken_us <= longest.period_us or not longest.causes:
        return ""
    share = longest.causes[0]
    return f": {share.name} {microseconds(share.us)}"


def _rough(totals: RunTotals) -> Iterable[Finding]:
    wake_ups = totals.latency
    if wake_ups is None or wake_ups.share_over_150_us <= ROUGH_SHARE:
        return
    late = f"{wake_ups.share_over_150_us:.1%} came later than 150 us"
    helps = _wake_up_remedy(totals.real_time)
    yield Finding("rough_wake_ups", "machine", f"Wake-ups are rough: {late}.", helps)


def _wake_up_remedy(real_time: RealTime) -> str:
    """Return what makes wake-ups punctual: the next of scheduler, kernel and machine."""
    if not real_time.requested:
        return "`loop: {scheduler: {policy: round_robin}}` in the robot file helps."
    if not real_time.granted:
        return "The real-time scheduler that the robot file asks for was not granted, and would help."
    if not real_time.kernel:
        return "The real-time scheduler was granted; a real-time kernel helps."
    return "Scheduler and kernel are real-time ones, so it is the machine: see `dxlrun doctor`."


def _steered(acts: Sequence[Act], pauses: Sequence[Pause]) -> Iterable[Finding]:
    """Report the commands from outside."""
    asked = [act for act in acts if act.origin != "loop"]
    if not asked:
        return
    done = Counter(
        _KINDS.get(act.kind, "command")
        for act in asked
        if not (act.refusal or act.set_points or act.kind == "resume")  # a pause has an end
    )
    parts = [counted(count, what, _MANY.get(what, f"{what}s")) for what, count in done.items()]
    streams = [act for act in asked if act.set_points and not act.refusal]
    if streams:
        points = counted(sum(act.set_points for act in streams), "set-point", "set-points")
        parts.append(f"{counted(len(streams), 'stream', 'streams')} of {points}")
    refused = sum(bool(act.refusal) for act in asked)
    parts += [f"{refused} refused"] if refused else []
    still = sum(pause.end_s - pause.begin_s for pause in pauses)
    paused = f"; it was paused for {microseconds(still * 1e6)}" if pauses else ""
    yield Finding("steered", "", f"It was steered from outside: {', '.join(parts)}{paused}.")


# What was lost


def _of(events: Iterable[EventGroup], *codes: EventCode) -> list[EventGroup]:
    return [group for group in events if group.code in codes and group.severity >= Severity.ERROR]


_REPLUG = "Check the adapter's plugs and cable; `dmesg` has what the system saw of it."


def _lines(totals: RunTotals) -> Iterable[Finding]:
    for group in _of(totals.events, EventCode.PORT_LOST):
        times = "" if group.count == 1 else f" {group.count} times"
        line = _line(group)
        sentence = f"Bus {group.source} was lost{times}: {line}" + ("" if line.endswith("?") else ".")
        yield Finding("bus_lost", group.source, sentence, _REPLUG, Rank.LINE, group.count)


_HURTS = {
    EventCode.SERVO_REBOOTED: "rebooted",
    EventCode.SERVO_LOST: "was lost",
    EventCode.SERVO_LIMP: "lost its torque",
}


_CODES = {
    EventCode.SERVO_REBOOTED: "servo_rebooted",
    EventCode.SERVO_LOST: "servo_lost",
    EventCode.SERVO_LIMP: "torque_lost",
}
_FIXES = {
    EventCode.SERVO_REBOOTED: "Check its plugs, and whether the supply can give the current.",
    EventCode.SERVO_LOST: "Check its cable, plugs and supply; `dxlrun scan PORT` shows which servos answer.",
    EventCode.SERVO_LIMP: "Look for overload, heat, low voltage: `dxlrun servo PORT ID get` has its errors.",
}
_FEWEST_OF_BUS = 2
_AT_ONCE_NS = 500_000_000


def _lost_servos(totals: RunTotals) -> Iterable[Finding]:
    """Report each servo that was lost, rebooted or lost its torque; the worst ones first."""
    by_source: dict[str, list[EventGroup]] = {}
    for group in _of(totals.events, *_HURTS):
        by_source.setdefault(group.source, []).append(group)
    if not by_source:
        return
    failed = []
    ordered = sorted(by_source.items(), key=lambda item: -sum(group.count for group in item[1]))
    for source, happened in ordered:
        parts = [
            what if group.count == 1 else f"{what} {group.count} times"
            for code, what in _HURTS.items()
            for group in happened
            if group.code == code
        ]
        failed.append(f"{source} {_joined(parts)}")
    named = "; ".join(failed[:_MOST_NAMED])
    sentence = f"Servos failed: {named}{_more('; and', len(failed))}."
    codes = {group.code for group in ordered[0][1]}
    first = next(code for code in _HURTS if code in codes)
    fix = _FIXES[first]
    if _share_a_cable(totals, [group for groups in by_source.values() for group in groups]):
        sentence += " They were lost at once, while others of their bus answered."
        fix = "Look at the cable or the plug that they share, between them and those that answered."
    yield Finding(_CODES[first], ordered[0][0], sentence, fix, Rank.SERVO)


def _share_a_cable(totals: RunTotals, failed: Sequence[EventGroup]) -> bool:
    """Return whether several servos of a bus were lost once and at once, and not all that it has."""
    bus_of = {servo.joint: servo.bus for servo in totals.servos if servo.joint and not servo.device}
    (bus, *others), times = {bus_of.get(one.source, "") for one in failed}, [one.t_ns for one in failed]
    once = all(one.code == EventCode.SERVO_LOST and one.count == 1 for one in failed)
    few = _FEWEST_OF_BUS <= len(failed) < list(bus_of.values()).count(bus)
    return once and few and not others and max(times) - min(times) <= _AT_ONCE_NS


def _lost_devices(totals: RunTotals) -> Iterable[Finding]:
    """Report each device that was lost; the worst ones first."""
    lost: dict[str, int] = {}
    for group in _of(totals.events, EventCode.DEVICE_LOST):
        lost[group.source] = lost.get(group.source, 0) + group.count
    if lost:
        ordered = sorted(lost, key=lambda name: -lost[name])
        named = "; ".join(
            name if lost[name] == 1 else f"{name} {lost[name]} times" for name in ordered[:_MOST_NAMED]
        )
        sentence = f"Devices were lost: {named}{_more('; and', len(ordered))}."
        fix = "Check its cable, plugs and supply; its states kept their last values meanwhile."
        yield Finding("device_lost", ordered[0], sentence, fix, Rank.SERVO)


def _whole_buses(totals: RunTotals) -> Iterable[Finding]:
    """Report what happened to all servos of a bus: they share supply and adapter."""
    gone = {group.source for group in _of(totals.events, EventCode.PORT_LOST)}
    servos = [servo for servo in totals.servos if servo.joint and not servo.device]
    for bus in sorted({servo.bus for servo in servos} - gone):
        joints = {servo.joint for servo in servos if servo.bus == bus}
        times = {
            code: {group.source: group.t_ns for group in _of(totals.events, code) if group.source in joints}
            for code in (EventCode.SERVO_REBOOTED, EventCode.SERVO_LOST)
        }
        for code, happened in times.items():
            if len(joints) < _FEWEST_OF_BUS or set(happened) != joints:
                continue
            if max(happened.values()) - min(happened.values()) > _AT_ONCE_NS:
                continue
            if code == EventCode.SERVO_REBOOTED:
                what = f"All {len(joints)} servos of bus {bus} rebooted at once: their supply failed."
                fix = "Check the supply, its plug and its switch."
                yield Finding("power_lost", bus, what, fix, Rank.SERVO_CAUSE, 2.0)
            else:
                what = f"All {len(joints)} servos of bus {bus} were lost at once: it is not one of them."
                fix = "Check the adapter, the first cable and the supply of the bus."
                yield Finding("silent_bus", bus, what, fix, Rank.SERVO_CAUSE)
            break


def _joined(parts: Sequence[str]) -> str:
    *others, last = parts
    return f"{', '.join(others)} and {last}" if others else last


def _invalid(totals: RunTotals) -> Iterable[Finding]:
    """Name the joints whose states were invalid too often; the cycles that were skipped have none."""
    cycles = totals.periods.records
    counts = {
        joint: count
        for joint, count in zip(totals.joints, totals.invalid, strict=False)
        if cycles and count > max(_FEW_INVALID, INVALID_SHARE * cycles)
    }
    if not counts:
        return
    waited = _waited(totals, counts)
    ordered = sorted((-count / cycles, joint) for joint, count in counts.items() if joint not in waited)
    most = max(counts.values()) / cycles
    if ordered:
        named = ", ".join(f"{joint} in {-share:.1%}" for share, joint in ordered[:_MOST_NAMED])
        more = _more(", and", len(ordered), "more joint", "more joints")
        subject = ordered[0][1]
        sentence = f"States were invalid: {named} of the cycles{more}"
        sentence += (
            f", and of {len(waited)} more because replies before theirs were missing" if waited else ""
        )
    else:
        buses = sorted({mover.bus.name for joint in waited for mover in totals.plan.movers[joint]})
        subject = buses[0] if len(buses) == 1 else ""
        joints = counted(len(waited), "joint", "joints")
        sentence = (
            f"States of {joints} on bus {_joined(buses)} were invalid, in up to {most:.1%} of the cycles, as "
            "whole chains of replies were missing: it is the line, or the first servo of the chain"
        )
    yield Finding(
        "invalid_states", subject, f"{sentence}; {INVALID_SHARE:.0%} tolerated.", rank=Rank.SHARE, share=most
    )


def _waited(totals: RunTotals, counts: Mapping[str, int]) -> set[str]:
    """Return the joints whose missing replies are for the most part not their servos' own."""
    servos = {(servo.bus, servo.servo_id): servo for servo in totals.servos}
    found = set()
    for joint, movers in totals.plan.movers.items():
        mine = [servos.get((mover.bus.name, mover.servo.servo_id)) for mover in movers]
        lost = sum(one.lost for one in mine if one)
        own = sum(one.losses.lost for one in mine if one and one.losses)
        if joint in counts and 2 * (lost - own) >= counts[joint] > 2 * own:
            found.add(joint)
    return found


def _implausible(totals: RunTotals) -> Iterable[Finding]:
    """Name joints whose positions the loop did not believe, where their bus has no spoilt replies."""
    named = {one.subject for one in totals.findings if one.code in (*_SPOILT, "position_jumped")}
    for group in totals.events:
        movers = totals.plan.movers.get(group.source, ())
        if group.code == EventCode.IMPLAUSIBLE and movers and not named & {group.source, movers[0].bus.name}:
            sentence = f"{_line(group)}: its encoder is bad or loose, a gear slips, or a hand turned it."
            fix = "Turn it by hand without torque, and watch its position."
            yield Finding("position_jumped", group.source, sentence, fix, Rank.CAUSE, 4.0)


def _silent(totals: RunTotals) -> Iterable[Finding]:
    asked = [servo for servo in totals.servos if servo.asked]
    if not asked:
        return
    losers = sorted((servo for servo in asked if servo.lost), key=lambda servo: -servo.lost)
    if not losers and any(
        _of(totals.events, EventCode.PORT_LOST, EventCode.SERVO_LOST, EventCode.DEVICE_LOST)
    ):
        return  # they answered while they were asked; what was lost is told above
    if not losers:
        yield Finding("all_answered", "", f"{_all(asked)} answered every time.")
        return
    named = ", ".join(
        f"{_name(servo)} {servo.lost} of {servo.asked} times ({servo.lost / servo.asked:.2%})"
        for servo in losers[:_MOST_NAMED]
    )
    more = _more(", and", len(losers))
    rest = len(asked) - len(losers)
    others = f"; {rest} of {len(asked)} {_kinds(asked)} answered every time" if rest else ""
    sentence = f"Replies are missing: {named}{more}{others}."
    yield Finding("missing_replies", _subject(losers[0]), sentence)


def _all(asked: Sequence[ServoTraffic]) -> str:
    return f"All {len(asked)} {_kinds(asked)}" if len(asked) > 1 else "The servo"


def _kinds(asked: Sequence[ServoTraffic]) -> str:
    return "servos and devices" if any(one.device for one in asked) else "servos"


def _errors(servos: Sequence[ServoTraffic]) -> Iterable[Finding]:
    troubled = [servo for servo in servos if servo.errors]
    if not troubled:
        return
    named = "; ".join(
        f"{_name(servo)}: {', '.join(servo.error_names) or 'unknown bit'} in "
        f"{counted(servo.errors, 'reply', 'replies')}"
        for servo in troubled[:_MOST_NAMED]
    )
    more = _more("; and", len(troubled))
    sentence = f"Servos reported errors: {named}{more}."
    yield Finding("servo_errors", _subject(troubled[0]), sentence, rank=Rank.ERROR)


def _more(joining: str, count: int, one: str = "more servo", many: str = "more servos") -> str:
    """Return how many there are beyond those that are named."""
    beyond = count - _MOST_NAMED
    return f"{joining} {counted(beyond, one, many)}" if beyond > 0 else ""


def _name(servo: ServoTraffic) -> str:
    kind = "device" if servo.device else "servo"
    return f"{kind} {servo.servo_id} ({servo.joint or servo.bus})"


def _subject(servo: ServoTraffic) -> str:
    return servo.joint or f"{servo.bus} {servo.servo_id}"


_OTHER_RULES = frozenset((*_HURTS, EventCode.DEVICE_LOST, EventCode.PORT_LOST, EventCode.RECORDER_GAP))
"""Events that other rules report."""


def _events(totals: RunTotals) -> Iterable[Finding]:
    """Report errors that were logged, but for those of controllers whose fallbacks took over."""
    taken_over = {one.controller for one in totals.conduct.takeovers} - set(totals.conduct.unanswered)
    severe = [
        group
        for group in totals.events
        if group.severity >= Severity.ERROR
        and group.code not in _OTHER_RULES
        and not (group.code == EventCode.CONTROLLER_FAULT and group.source in taken_over)
    ]
    if severe:
        count = sum(group.count for group in severe)
        first = min(severe, key=lambda group: group.t_ns)
        number = "One error was" if count == 1 else f"{count} errors were"
        sentence = f"{number} logged; the first, of {first.source}: {_line(first)}"
        yield Finding("errors_logged", first.source, sentence, rank=Rank.ERROR)


def _line(group: EventGroup) -> str:
    """Return the last line of an event's text: of a traceback what was raised."""
    return group.text.strip().splitlines()[-1] if group.text.strip() else group.name


def _log(totals: RunTotals) -> Iterable[Finding]:
    faults = list(totals.damage)
    if totals.gaps:
        lost = counted(totals.gaps, "record was", "records were")
        faults.append(f"{lost} lost on the way to the recorder")
    if not totals.periods.agree:
        missing = counted(totals.periods.missing, "period is", "periods are")
        faults.append(f"{missing} neither recorded nor declared skipped")
    if faults:
        sentence = f"The log is not whole: {'; '.join(faults)}."
        yield Finding("log_not_whole", "log", sentence, rank=Rank.LOG)
