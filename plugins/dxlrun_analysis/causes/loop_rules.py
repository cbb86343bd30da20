"""Rule of the verdict about the loop: causes within the loop that made cycles too long.

A cause is reported if it has at least half of the excess of all long cycles, and a share in at least three
cycles: one stall of a machine is not evidence. Late and missing replies are judged by the rules about buses
and servos, which know whether the other servos of the bus answered.
"""

from __future__ import annotations

from collections.abc import Iterable

from dxlrun.tooling.output import counted, microseconds
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.cycles.worst_cycles import Cause, CauseKind
from dxlrun_analysis.finding import Finding, Rank

_LEAST_CYCLES = 3  # One stall of a machine is not evidence
_MOST_OF_IT = 0.5  # Share of the excess of all long cycles
_OWN: dict[CauseKind, str] = {
    "controller": "Controller {} made cycles too long: its update took {}.",
    "own work": "The loop's own work, or an interruption, took {1}.",
    "write call": "The write() calls of {} made cycles too long: they took {}.",
    "plan": "The planned exchange alone exceeds the period by {1}.",
}


def own_work(causes: Causes) -> Iterable[Finding]:
    """Report each cause within the loop that made cycles too long, the largest first: a controller, own
    work, write() calls, or a planned exchange longer than the period."""
    total_ns = sum(one.long_ns for one in causes.causes)
    for one in causes.causes:
        cycles = min(one.cycles, causes.long)
        if one.kind in _OWN and cycles >= _LEAST_CYCLES and one.long_ns >= _MOST_OF_IT * total_ns > 0:
            in_cycles = counted(cycles, "cycle", "cycles")
            took = f"{microseconds(one.long_ns / 1e3)} of {microseconds(total_ns / 1e3)} in {in_cycles}"
            sentence = _OWN[one.kind].format(one.subject, took)
            share = one.long_ns / total_ns
            yield Finding("own_work", _subject(one), sentence, rank=Rank.CAUSE, share=share)


def _subject(one: Cause) -> str:
    """Return the part that a cause accuses,as findings name it: `loop`, a controller or a bus."""
    return "loop" if one.kind in ("own work", "plan") else one.subject.removeprefix("bus ")
