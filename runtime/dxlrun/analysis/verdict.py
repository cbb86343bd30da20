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

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum, unique

from dxlrun.analysis.servos.traffic import BusTraffic, ServoTraffic
from dxlrun.analysis.steering import Act, Pause
from dxlrun.analysis.tally import RunTotals
from dxlrun.dynamixel.port.latency_timer import late_replies
from dxlrun.errors import counted
from dxlrun.output.table import microseconds
from dxlrun.run.channels.events import EventCode, EventGroup, Severity

INVALID_SHARE = 0.01
"""More invalid states of a joint than this, and the run was not good."""
_FEW_INVALID = 2
"""So few are tolerated however short the run: a servo that misses three replies in a row is lost."""
_SHORT_RUN_S = 2.0
"""A shorter run may skip as much as one of this: a machine that stalls once is not overloaded."""
ROUGH_SHARE = 0.01
_LATE_US = 2000
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
    """Sentences for a person; `good` when nothing went wrong that a run may not have."""

    good: bool
    sentences: tuple[str, ...]
    """The most severe first."""

    @property
    def word(self) -> str:
        """The verdict in a word or two."""
        return "good" if self.good else "not good"


@unique
class _Rank(IntEnum):
    """Severity of a finding; the first is the worst."""

    NEVER_RAN = 0
    """Nor to its end, where a process of the run failed."""
    LINE = 1
    SERVO = 2
    SHARE = 3
    """Of the time: joints and periods, the largest share first."""
    ERROR = 4
    LOG = 5
    REMARK = 6


@dataclass(frozen=True, slots=True)
class _Finding:
    rank: _Rank
    sentence: str
    share: float = 0.0

    @property
    def order(self) -> tuple[int, float]:
        """By it findings are sorted; those of one place keep theirs."""
        return self.rank, -self.share


def judge(totals: RunTotals) -> Verdict:
    """Return whether a run was good, and in sentences what was and what was not."""
    found = sorted(
        (
            *(_Finding(_Rank.NEVER_RAN, f"The run failed: {failed}.") for failed in totals.failures),
            *_loop(totals),
            *_lines(totals),
            *_lost_servos(totals),
            *_invalid(totals),
            *_slow(totals),
            *_rough(totals),
            *_steered(totals.acts, totals.pauses),
            *_late_replies(totals.buses),
            *_silent(totals.servos),
            *_errors(totals.servos),
            *_events(totals.events),
            *_log(totals),
        ),
        key=lambda finding: finding.order,
    )
    good = all(finding.rank == _Rank.REMARK for finding in found)
    return Verdict(good, tuple(finding.sentence for finding in found))


def _loop(totals: RunTotals) -> Iterable[_Finding]:
    account, wake_ups = totals.periods, totals.latency
    if not account.records:
        yield _Finding(_Rank.NEVER_RAN, "The loop never ran a cycle.")
        return
    share = account.skipped / account.elapsed
    judged = max(account.elapsed, _SHORT_RUN_S * account.rate_hz)
    tolerable = account.skipped <= totals.tolerated_skips * judged
    kept = "kept" if tolerable else "did not keep"
    wake_up = f", worst wake-up {microseconds(wake_ups.max_us)} late" if wake_ups is not None else ""
    wake_up = ", on virtual time" if totals.virtual else wake_up
    elapsed = counted(account.elapsed, "period", "periods")
    if totals.schedule == "sequential":
        took = f"{elapsed} of {account.rates} took {account.seconds:.3f} s"
        yield _Finding(_Rank.REMARK, f"Cycles followed each other, not the clock: {took}{wake_up}.")
        return
    tolerated = f"{totals.tolerated_skips * 100:.4g}% tolerated"
    if judged > account.elapsed:
        tolerated = f"{totals.tolerated_skips * judged:.0f} tolerated in a short run"
    shares = f" ({share:.2%}; {tolerated})" if account.skipped else ""
    sentence = f"The loop {kept} {account.rates}: {account.skipped} of {elapsed} skipped{shares}{wake_up}."
    yield _Finding(_Rank.REMARK if tolerable else _Rank.SHARE, sentence, 0.0 if tolerable else share)


def _slow(totals: RunTotals) -> Iterable[_Finding]:
    """Report the longest step of the cycle that exceeds its period most."""
    slowest = totals.slowest
    if slowest is None:
        return
    steps = ((slowest.read_ns, "read"), (slowest.update_ns, "update"), (slowest.write_ns, "write"))
    longest_ns, name = max(steps)
    yield _Finding(
        _Rank.REMARK,
        f"A cycle took up to {microseconds(slowest.lasted_ns / 1e3)}, longer than its period of "
        f"{microseconds(slowest.period_ns / 1e3)}; its {name} took {microseconds(longest_ns / 1e3)}.",
    )


def _rough(totals: RunTotals) -> Iterable[_Finding]:
    wake_ups, real_time = totals.latency, totals.real_time
    if wake_ups is None or wake_ups.share_over_150_us <= ROUGH_SHARE:
        return
    if not real_time.requested:
        helps = "`loop: {scheduler: {policy: round_robin}}` in the robot file helps"
    elif not real_time.granted:
        helps = "the real-time scheduler that the robot file asks for was not granted, and would help"
    elif not real_time.kernel:
        helps = "the real-time scheduler was granted; a real-time kernel helps"
    else:
        helps = "scheduler and kernel are real-time ones, so it is the machine: see `dxlrun doctor`"
    yield _Finding(
        _Rank.REMARK,
        f"Wake-ups are rough: {wake_ups.share_over_150_us:.1%} came later than 150 us; {helps}.",
    )


def _steered(acts: Sequence[Act], pauses: Sequence[Pause]) -> Iterable[_Finding]:
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
    yield _Finding(_Rank.REMARK, f"It was steered from outside: {', '.join(parts)}{paused}.")


# What was lost


def _of(events: Iterable[EventGroup], *codes: EventCode) -> list[EventGroup]:
    return [group for group in events if group.code in codes and group.severity >= Severity.ERROR]


def _lines(totals: RunTotals) -> Iterable[_Finding]:
    for group in _of(totals.events, EventCode.PORT_LOST):
        times = "" if group.count == 1 else f" {group.count} times"
        yield _Finding(_Rank.LINE, f"Bus {group.source} was lost{times}: {_line(group)}.", group.count)


_HURTS = {
    EventCode.SERVO_REBOOTED: "rebooted",
    EventCode.SERVO_LOST: "was lost",
    EventCode.SERVO_LIMP: "lost its torque",
}


def _lost_servos(totals: RunTotals) -> Iterable[_Finding]:
    """Report each servo that was lost, rebooted or lost its torque; the worst ones first."""
    by_source: dict[str, list[EventGroup]] = {}
    for group in _of(totals.events, *_HURTS):
        by_source.setdefault(group.source, []).append(group)
    if not by_source:
        return
    failed = []
    for source, happened in sorted(
        by_source.items(), key=lambda item: -sum(group.count for group in item[1])
    ):
        parts = [
            what if group.count == 1 else f"{what} {group.count} times"
            for code, what in _HURTS.items()
            for group in happened
            if group.code == code
        ]
        failed.append(f"{source} {_joined(parts)}")
    named = "; ".join(failed[:_MOST_NAMED])
    yield _Finding(_Rank.SERVO, f"Servos failed: {named}{_more('; and', len(failed))}.")


def _joined(parts: Sequence[str]) -> str:
    *others, last = parts
    return f"{', '.join(others)} and {last}" if others else last


def _invalid(totals: RunTotals) -> Iterable[_Finding]:
    """Name the joints whose states were invalid too often; the cycles that were skipped have none."""
    cycles = totals.periods.records
    shares = [
        (count / cycles, joint)
        for joint, count in zip(totals.joints, totals.invalid, strict=False)
        if cycles and count > max(_FEW_INVALID, INVALID_SHARE * cycles)
    ]
    if shares:
        ordered = sorted(shares, key=lambda one: (-one[0], one[1]))
        named = ", ".join(f"{joint} in {share:.1%}" for share, joint in ordered[:_MOST_NAMED])
        more = _more(", and", len(ordered), "more joint", "more joints")
        sentence = f"States were invalid: {named} of the cycles{more}; {INVALID_SHARE:.0%} tolerated."
        yield _Finding(_Rank.SHARE, sentence, ordered[0][0])


def _late_replies(buses: Sequence[BusTraffic]) -> Iterable[_Finding]:
    """Compare what adapters add to the time of replies with the plan."""
    for bus in buses:
        extra, planned = bus.extra_us, bus.planned_latency_us
        if extra is None or planned is None or extra < planned + _LATE_US:
            continue
        sentence = late_replies(bus.name, bus.port, extra * 1e3, planned * 1e3)
        yield _Finding(_Rank.REMARK, f"{sentence[0].upper()}{sentence[1:]}.")


def _silent(servos: Sequence[ServoTraffic]) -> Iterable[_Finding]:
    asked = [servo for servo in servos if servo.asked]
    if not asked:
        return
    losers = sorted((servo for servo in asked if servo.lost), key=lambda servo: -servo.lost)
    if not losers:
        yield _Finding(_Rank.REMARK, f"{_all(len(asked))} answered every time.")
        return
    named = ", ".join(
        f"{_name(servo)} {servo.lost} of {servo.asked} times ({servo.lost / servo.asked:.2%})"
        for servo in losers[:_MOST_NAMED]
    )
    more = _more(", and", len(losers))
    rest = len(asked) - len(losers)
    others = f"; {rest} of {len(asked)} servos answered every time" if rest else ""
    yield _Finding(_Rank.REMARK, f"Replies are missing: {named}{more}{others}.")


def _all(count: int) -> str:
    return "The servo" if count == 1 else f"All {count} servos"


def _errors(servos: Sequence[ServoTraffic]) -> Iterable[_Finding]:
    troubled = [servo for servo in servos if servo.errors]
    if not troubled:
        return
    named = "; ".join(
        f"{_name(servo)}: {', '.join(servo.error_names) or 'unknown bit'} in "
        f"{counted(servo.errors, 'reply', 'replies')}"
        for servo in troubled[:_MOST_NAMED]
    )
    more = _more("; and", len(troubled))
    yield _Finding(_Rank.ERROR, f"Servos reported errors: {named}{more}.")


def _more(joining: str, count: int, one: str = "more servo", many: str = "more servos") -> str:
    """Return how many there are beyond those that are named."""
    beyond = count - _MOST_NAMED
    return f"{joining} {counted(beyond, one, many)}" if beyond > 0 else ""


def _name(servo: ServoTraffic) -> str:
    return f"servo {servo.servo_id} ({servo.joint or servo.bus})"


_OTHER_RULES = frozenset((*_HURTS, EventCode.PORT_LOST, EventCode.RECORDER_GAP))
"""Events that other rules report."""


def _events(events: Sequence[EventGroup]) -> Iterable[_Finding]:
    severe = [
        group for group in events if group.severity >= Severity.ERROR and group.code not in _OTHER_RULES
    ]
    if severe:
        count = sum(group.count for group in severe)
        first = min(severe, key=lambda group: group.t_ns)
        number = "One error was" if count == 1 else f"{count} errors were"
        sentence = f"{number} logged; the first, of {first.source}: {_line(first)}"
        yield _Finding(_Rank.ERROR, sentence)


def _line(group: EventGroup) -> str:
    """Return the last line of an event's text: of a traceback what was raised."""
    return group.text.strip().splitlines()[-1] if group.text.strip() else group.name


def _log(totals: RunTotals) -> Iterable[_Finding]:
    faults = list(totals.damage)
    if totals.gaps:
        lost = counted(totals.gaps, "record was", "records were")
        faults.append(f"{lost} lost on the way to the recorder")
    if not totals.periods.agree:
        missing = counted(totals.periods.missing, "period is", "periods are")
        faults.append(f"{missing} neither recorded nor declared skipped")
    if faults:
        yield _Finding(_Rank.LOG, f"The log is not whole: {'; '.join(faults)}.")
