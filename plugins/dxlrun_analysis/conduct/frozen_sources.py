"""Frozen sources: sensors and devices whose samples stopped changing, identical to the bit.

Times count only cycles with valid values. A standstill is reported only if it lasts a second, and ten times
as long as any standstill before.

- A source that a process samples is frozen if no value changes while joints move.
- A value that trembled is frozen if it stops changing. A value trembled if 16 of its last 40 changes
  reversed direction, and it took several distinct values. Most of the frozen values must be within the range
  that they had before: an extreme value can be genuine, such as that of a foot in the air. A source is
  reported if all its trembling values freeze at once, while joints move or after they also trembled at
  rest. A single value is reported if others still tremble.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats, Log
from dxlrun_analysis.finding import Finding, Rank, listed
from dxlrun_analysis.plan_excerpt import LoggedPlan, plan_of

_HANGS_S = 1.0
_TIMES_LONGER = 10
"""Required ratio of a standstill to the longest before. A switch rarely changes, and neither does a
simulated sensor without noise at rest."""
_MOVED_RAD = 0.1  # At rest, a simulated sensor can measure a constant value
_RESTED_RAD = 0.02  # Joints that move less are at rest
_CHANGES = 40
"""Number of the last changes of a value that show whether it trembles."""
_REVERSALS = 16
"""Reversals of direction among these changes; a measured movement keeps its direction for longer."""
_FEWEST_VALUES = 4  # A voltage that alternates between two steps has only two values
_FEWEST_ALONE = 8  # Bound for a single value while others still tremble
_MOST_NAMED = 4

Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class _LongestStandstill:
    """Longest time in which a value (or all of a source) did not change, with its circumstances."""

    hung_s: float = 0.0
    from_s: float = 0.0
    usual_s: float = 0.0  # Longest standstill before
    moved: bool = False  # Joints moved during the standstill
    values: int = 0  # Distinct values in the changes before; 0 if it did not tremble
    inside: bool = False  # The value is not 0 and not an extreme of its range
    rested: bool = False  # It trembled while no joint moved


@dataclass(slots=True)
class _ChangeHistory:
    """Recent changes of one value of a source, or of all its values together, and its longest standstill."""

    since_ns: int  # Time of the last change
    position: Floats  # Joint positions at that change
    moved: bool = False  # Joints have moved since then
    longest_ns: int = 0  # Longest time between two changes
    low: float = np.inf
    high: float = -np.inf
    recent: Floats = field(default_factory=lambda: np.zeros(0))
    """The value after each of its last 40 changes."""
    places: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """Joint positions at each of the last 40 changes, shape (changes, joints)."""
    stay: _LongestStandstill = field(default_factory=_LongestStandstill)

    def add_values(self, at_ns: Times, values: Floats, changed: NDArray[np.bool_], position: Floats) -> None:
        """Add cycles in which the source was valid.

        Args:
            at_ns: Valid time since the first cycle, ns; shape (cycles,).
            values: The value in each cycle; zeros for a whole source.
            changed: Cycles in which the value changed.
            position: Joint positions, rad; shape (cycles, joints).
        """
        rows = np.flatnonzero(changed)
        times = np.concatenate([[self.since_ns], at_ns[rows], at_ns[-1:]])
        longest = np.maximum.accumulate(np.append(self.longest_ns, np.diff(times)))
        recent = np.append(self.recent, values[rows])
        places = np.vstack([self.places.reshape(-1, position.shape[1]), position[rows]])
        kept = len(self.recent)
        for gap in np.flatnonzero(np.diff(times) > max(_HANGS_S, self.stay.hung_s) * 1e9).tolist():
            begin, end = times[gap : gap + 2].tolist()
            if end - begin <= _TIMES_LONGER * longest[gap] or not longest[gap]:
                continue
            there = position[rows[gap - 1]] if gap else self.position
            during = position[(at_ns >= begin) & (at_ns <= end)]
            moved = bool(np.abs(during - there).max(initial=0.0) > _MOVED_RAD) or (not gap and self.moved)
            upto = slice(max(0, kept + gap - _CHANGES), kept + gap)
            low = min(self.low, recent[: kept + gap].min(initial=np.inf))
            high = max(self.high, recent[: kept + gap].max(initial=-np.inf))
            at = recent[kept + gap - 1] if kept + gap else 0.0
            rested = len(places[upto]) > 1 and float(np.ptp(places[upto], axis=0).max()) < _RESTED_RAD
            inside = bool(low < at < high and at != 0.0)
            self.stay = _LongestStandstill(
                (end - begin) * 1e-9,
                begin * 1e-9,
                int(longest[gap]) * 1e-9,
                moved,
                _trembled(recent[upto]),
                inside,
                rested,
            )
        if len(rows):
            self.since_ns, self.position, self.moved = int(at_ns[rows[-1]]), position[rows[-1]].copy(), False
            self.low, self.high = min(self.low, recent.min()), max(self.high, recent.max())
            self.recent, self.places = recent[-_CHANGES:].copy(), places[-_CHANGES:].copy()
        since = position[rows[-1] :] if len(rows) else position
        self.moved |= bool(np.abs(since - self.position).max(initial=0.0) > _MOVED_RAD)
        self.longest_ns = int(longest[-2])  # The last standstill can continue in the next slice


class _Source:
    """Change history of one source: of each value, and of all values together."""

    def __init__(self, at_ns: int, values: Floats, position: Floats) -> None:
        self._at_ns, self._lived_ns, self._was_valid, self._last = at_ns, 0, True, values
        self.all = _ChangeHistory(0, position)
        self.each = [_ChangeHistory(0, position) for _ in values]

    def add_cycles(self, at_ns: Times, valid: NDArray[np.bool_], values: Floats, position: Floats) -> None:
        """Add cycles: times in ns, validity, values of shape (cycles, values), and joint positions."""
        between = np.diff(at_ns, prepend=self._at_ns)
        between[~valid | ~np.append(self._was_valid, valid[:-1])] = 0
        lived = (self._lived_ns + np.cumsum(between))[valid]
        self._at_ns, self._was_valid = int(at_ns[-1]), bool(valid[-1])
        values, position = values[valid], position[valid]
        if not len(values):
            return
        self._lived_ns = int(lived[-1])
        changed = np.vstack([self._last, values[:-1]]) != values
        self._last = values[-1].copy()
        self.all.add_values(lived, np.zeros(len(lived)), changed.any(axis=1), position)
        for one, mine, column in zip(self.each, changed.T, values.T, strict=True):
            one.add_values(lived, column, mine, position)


class FrozenSources:
    """Accumulator that finds frozen sensors and devices. Its memory does not grow with the log."""

    def __init__(self) -> None:
        self._sources: dict[str, _Source] = {}
        self._plan, self._states = LoggedPlan(), dict[str, tuple[str, ...]]()

    def add_slice(self, log: Log) -> None:
        """Add the source values in the cycles of the next slice of the log."""
        if not len(log.cycles) or not log.header.sources:
            return
        self._plan, self._states = plan_of(log), dict(log.header.sources)
        known = {source.name for source in self._plan.loop.sources}
        names = [
            (index, name) for index, name in enumerate(self._states) if self._states[name] and name in known
        ]
        if not names:
            return
        position, at_ns = np.nan_to_num(log.cycles["position"]), log.cycles["read_ns"]
        for index, name in names:
            valid = log.cycles["source_valid"][:, index]
            values = np.nan_to_num(log.cycles["source_state"][:, log.header.layout.source_slice(name)])
            if name not in self._sources:
                if not valid.any():
                    continue
                first = int(np.argmax(valid))
                valid, values = valid[first:], values[first:]
                self._sources[name] = _Source(int(at_ns[first]), values[0], position[first])
                self._sources[name].add_cycles(at_ns[first:], valid, values, position[first:])
            else:
                self._sources[name].add_cycles(at_ns, valid, values, position)

    def findings(self) -> Iterable[Finding]:
        """Report each sensor or device that was frozen as a whole, and single values that were."""
        sampled = self._plan.sampled
        for name, one in self._sources.items():
            whole, stays = one.all.stay, [each.stay for each in one.each]
            still = {
                state: stay
                for state, stay in zip(self._states[name], stays, strict=True)
                if stay.values >= _FEWEST_VALUES
            }
            lively = sum(_trembled(each.recent) >= _FEWEST_VALUES for each in one.each)
            inside = sum(stay.inside for stay in still.values())
            if name in sampled and whole.hung_s and whole.moved:
                yield self._frozen(name, "all its values", whole, " while joints moved")
            elif still and len(still) == lively and _at_once(still.values()):
                if 2 * inside >= lively and any(each.moved or each.rested for each in still.values()):
                    stay = max(still.values(), key=lambda stay: stay.from_s)
                    yield self._frozen(name, listed(list(still), _MOST_NAMED), stay)
            else:
                for state, stay in still.items():
                    if stay.values >= _FEWEST_ALONE and stay.inside and lively > len(still):
                        others = ", while its other values changed"
                        yield replace(self._frozen(name, state, stay, others), rank=Rank.CAUSE)

    def _frozen(self, name: str, values: str, stay: _LongestStandstill, then: str = "") -> Finding:
        found = [(bus, each) for bus in self._plan.buses for each in bus.devices if each.name == name]
        where = "".join(f" (ID {each.servo_id} on bus {bus.name})" for bus, each in found)
        kind = next(source.kind for source in self._plan.loop.sources if source.name == name).capitalize()
        sentence = (
            f"{kind} {name}{where} is frozen: {values} stayed identical for {stay.hung_s:.1f} s{then}, "
            f"starting at {stay.from_s:.1f} s of the run; the longest time before was "
            f"{stay.usual_s * 1e3:.0f} ms."
        )
        return Finding("frozen", name, sentence, rank=Rank.SERVO_CAUSE, share=5.0)


def _trembled(values: Floats) -> int:
    """Return the number of distinct values among the last 40 changes of a value; 0 if it does not tremble."""
    values = values[-_CHANGES:]
    steps = np.diff(values)
    if len(values) < _CHANGES or np.count_nonzero(steps[1:] * steps[:-1] < 0) < _REVERSALS:
        return 0
    return len(np.unique(values))


def _at_once(stays: Collection[_LongestStandstill]) -> bool:
    """Return whether the standstills of several values began at the same time, up to 0.1 s and the longest
    standstill before."""
    begins = [stay.from_s for stay in stays]
    return max(begins) - min(begins) <= max(stay.usual_s for stay in stays) + 0.1
