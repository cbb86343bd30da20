"""The verdict: what a person wants to know first, in sentences.

Thresholds: the loop *kept* its rate when it skipped no period; wake-ups are *rough* when more than 1 % are
later than 150 us (M. A. Araujo, UFU 2017, measured 1.74 % at 1 kHz under stress on a stock kernel, none on a
real-time kernel); a servo is *named* when a single reply of it is missing or carries an error bit.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dxlrun.analysis.bus import Servo
from dxlrun.analysis.latency import Duration, Latency, Periods, cycle_periods_ns, on_virtual_time
from dxlrun.analysis.steering import Act, Pause
from dxlrun.events import Event, Severity
from dxlrun.plurals import counted
from dxlrun.recording.reader import Log

ROUGH_SHARE = 0.01
_MOST_NAMED = 3
_KINDS = {
    "switch": "switch",
    "rate": "change of the rate",
    "pause": "pause",
    "load": "controller loaded",
    "unload": "controller unloaded",
    "register": "register written",
    "stop": "stop",
}
_MANY = {
    "switch": "switches",
    "change of the rate": "changes of the rate",
    "controller loaded": "controllers loaded",
    "controller unloaded": "controllers unloaded",
    "register written": "registers written",
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """Sentences for a person; `good` when there is nothing to look into."""

    good: bool
    sentences: tuple[str, ...]
    errors: int = 0
    """How many were logged."""


@dataclass(frozen=True, slots=True)
class Timing:
    """How the loop kept its time: what the first sentences are about."""

    periods: Periods
    latency: Latency | None
    steps: Sequence[Duration]
    acts: Sequence[Act] = ()
    pauses: Sequence[Pause] = ()


def verdict(timing: Timing, servos: Sequence[Servo], log: Log, lost: int) -> Verdict:
    """Return the sentences: loop, servos, events, log; each says what is good as plainly as what is not.

    `lost`: records that the recorder did not get.
    """
    findings = [
        _loop(timing.periods, timing.latency, virtual=on_virtual_time(log)),
        _slow(log),
        _rough(timing.latency),
        _steered(timing.acts, timing.pauses),
        _silent(servos),
        _errors(servos),
        _events(log.events),
        _log(timing.periods, log, lost),
    ]
    said = [finding for finding in findings if finding is not None]
    good, sentences = all(good for good, _ in said), tuple(sentence for _, sentence in said)
    return Verdict(good, sentences, len(_grave(log.events)))


Finding = tuple[bool, str]


def _loop(account: Periods, wake_ups: Latency | None, *, virtual: bool) -> Finding:
    if wake_ups is None:
        return False, "The loop never ran a cycle."
    good = account.skipped == 0
    kept = "kept" if good else "did not keep"
    wake_up = "on virtual time" if virtual else f"worst wake-up {microseconds(wake_ups.max_us)} late"
    elapsed = counted(account.elapsed, "period", "periods")
    return good, (
        f"The loop {kept} {account.rates}: {account.skipped} of {elapsed} skipped"
        f"{'' if good else f' ({account.skipped / account.elapsed:.2%})'}, "
        f"{wake_up}."
    )


def _slow(log: Log) -> Finding | None:
    """Say which step made a cycle longer than its period, of the cycle that exceeds it most."""
    cycles, periods_ns = log.cycles, cycle_periods_ns(log)
    if not len(cycles):
        return None
    worst = int(np.argmax(cycles["written_ns"] - cycles["woken_ns"] - periods_ns))
    times = [int(cycles[name][worst]) for name in ("woken_ns", "read_ns", "updated_ns", "written_ns")]
    lasted_ns, period_ns = times[-1] - times[0], int(periods_ns[worst])
    if lasted_ns <= period_ns:
        return None
    steps_ns = (end - begin for begin, end in itertools.pairwise(times))
    longest_ns, name = max(zip(steps_ns, ("read", "update", "write"), strict=True))
    return False, (
        f"A cycle took up to {microseconds(lasted_ns / 1e3)}, longer than its period of "
        f"{microseconds(period_ns / 1e3)}; its {name} took {microseconds(longest_ns / 1e3)}."
    )


def _steered(acts: Sequence[Act], pauses: Sequence[Pause]) -> Finding | None:
    """Say what others asked of the loop in the run; nobody did: nothing."""
    asked = [act for act in acts if act.origin != "loop"]
    if not asked:
        return None
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
    return True, f"It was steered from outside: {', '.join(parts)}{paused}."


def _rough(wake_ups: Latency | None) -> Finding | None:
    if wake_ups is None or wake_ups.share_over_150_us <= ROUGH_SHARE:
        return None
    return False, (
        f"Wake-ups are rough: {wake_ups.share_over_150_us:.1%} came later than 150 us; "
        "a real-time kernel and a real-time scheduler help."
    )


def _silent(servos: Sequence[Servo]) -> Finding | None:
    asked = [servo for servo in servos if servo.asked]
    if not asked:
        return None
    losers = sorted((servo for servo in asked if servo.lost), key=lambda servo: -servo.lost)
    if not losers:
        return True, f"{_all(len(asked))} answered every time."
    named = ", ".join(
        f"{_name(servo)} {servo.lost} of {servo.asked} times ({servo.lost / servo.asked:.2%})"
        for servo in losers[:_MOST_NAMED]
    )
    more = _more(", and", len(losers))
    rest = len(asked) - len(losers)
    others = f"; {rest} of {len(asked)} servos answered every time" if rest else ""
    return False, f"Replies are missing: {named}{more}{others}."


def _all(count: int) -> str:
    return "The servo" if count == 1 else f"All {count} servos"


def _errors(servos: Sequence[Servo]) -> Finding | None:
    troubled = [servo for servo in servos if servo.errors]
    if not troubled:
        return None
    named = "; ".join(
        f"{_name(servo)}: {', '.join(servo.error_names) or 'unknown bit'} in "
        f"{counted(servo.errors, 'reply', 'replies')}"
        for servo in troubled[:_MOST_NAMED]
    )
    more = _more("; and", len(troubled))
    return False, f"Servos reported errors: {named}{more}."


def _more(joining: str, count: int) -> str:
    """Return how many servos there are beyond those that are named."""
    beyond = count - _MOST_NAMED
    return f"{joining} {counted(beyond, 'more servo', 'more servos')}" if beyond > 0 else ""


def _name(servo: Servo) -> str:
    return f"servo {servo.servo_id} ({servo.joint or servo.bus})"


def _events(events: Sequence[Event]) -> Finding | None:
    grave = _grave(events)
    if not grave:
        return None
    first = grave[0]
    line = first.text.strip().splitlines()[-1] if first.text.strip() else first.name
    number = "One error was" if len(grave) == 1 else f"{len(grave)} errors were"
    return False, f"{number} logged; the first, of {first.source}: {line}"


def _grave(events: Sequence[Event]) -> list[Event]:
    return [event for event in events if event.severity >= Severity.ERROR]


def _log(account: Periods, log: Log, lost: int) -> Finding | None:
    faults = list(log.damage)
    if lost:
        faults.append(f"{counted(lost, 'record was', 'records were')} lost on the way to the recorder")
    if not account.agree:
        faults.append(
            f"{counted(account.missing, 'period is', 'periods are')} neither recorded nor declared skipped"
        )
    if not faults:
        return None
    return False, f"The log is not whole: {'; '.join(faults)}."


def microseconds(value: float) -> str:
    """Return a time in us as a person writes it: us, ms or s."""
    if value >= 1e6:
        return f"{value / 1e6:.2f} s"
    return f"{value / 1e3:.2f} ms" if value >= 1e4 else f"{value:.0f} us"
