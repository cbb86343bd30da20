"""Joints that follow, but otherwise than they did, or than the others: what a mechanic sees of them.

- *play* and *friction*: at each turn a joint stands still until its goal is back by degrees, and is as far
  behind in both directions. Where that takes torque, something rubs; else something gives.
- *friction* is also what takes an eighth of its torque more in both directions, and twice as much as before.
- *softer*: it is behind in both directions by more than at its first turns, and does not stand still.
- *pulled*: it is off by 2 deg more than before, or takes an eighth of its torque more or less, at the same
  places; on one side the more the further it goes, it is held back there by a spring; where it takes next to
  none any more, it carries nothing.
- *jerked*: it is thrown off its way again and again, within 80 ms, while its goals are even.
- *hunts*: it swings evenly around its goal, by 0.6 deg, three times a second or more, where that does not.

All of it three times as much as in any other joint that moved, or any but one: where others show it too, it
is the motion, the ground or the supply. A joint that other rules name is left to them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence, Set
from typing import NamedTuple

import numpy as np

from dxlrun.channels.cycle import Floats
from dxlrun_analysis.finding import Finding
from dxlrun_analysis.joints.following import STROKE_RAD, Followed, Turn, Visit
from dxlrun_analysis.joints.kinds import finding

_OTHERS = 3.0  # So many times what any other joint shows
_FEWEST_OTHERS = 4
_SIDE = re.compile("left|right|(?<![a-z])[lr](?![a-z])", re.IGNORECASE)
_BEHIND_RAD = 0.03  # 1.7 deg
_FEWEST_TURNS = 2
_FASTER = 1.2
_STOOD = 1.2  # Part of how far it is behind by which the goal goes back before a joint that has play does
_FEWEST_ALIKE = 3  # With so many of its kind a joint needs no time before
_SOFTER = 2.0  # So many times its delay at its first turns
_LATE_S = 0.03
_OFF_RAD = 0.035  # 2 deg
_LOAD = 0.12  # Of its torque
_PULLED_S = 0.5
_FEWEST_VISITS = 3
_ALIKE = 0.8  # Part of the changes of its load that are of one sense
_NOTHING = 1 / 3  # Part of its load below which it carries nothing any more
_ALONG = 0.5  # Correlation
_JERK_RAD = 0.021  # 1.2 deg
_JERKS = 4
_APART_S = 0.15
_SWINGS = 10  # In a row, to and fro being two


class _Seen(NamedTuple):
    """One joint that no other rule names."""

    one: Followed
    turns: list[Turn]
    visits: list[Visit]
    jerks: Floats
    swings: Floats
    most: dict[str, float]  # The most that it shows of each quantity, 0.0 at least

    def does(self, code: str, since_s: float, text: str) -> Finding:
        """Return the finding about it; `text`: what it does, behind its name."""
        return finding(code, self.one.joint, text, since_s)


class _Others(NamedTuple):
    """The joints beside one."""

    of: _Seen
    all: list[_Seen]

    def most(self, quantity: str) -> float:
        """Return the most that others show, 0.0 at least.

        Of many others the worst may be another one that is not well; unless it is its mirror image, which the
        same happens to.
        """
        values = sorted((each.most[quantity], _plain(each) == _plain(self.of)) for each in self.all)
        alone = len(values) >= _FEWEST_OTHERS and not values[-1][1]
        return values[-2 if alone else -1][0] if values else 0.0

    def beside(self, theirs: float) -> str:
        """Return how a sentence compares with them."""
        return f" (other joints: at most {_deg(theirs)})" if self.all else ""


def worn(joints: Sequence[Followed], named: Set[int]) -> Iterator[Finding]:
    """Yield what joints show that no other does; `named`: the rows of those that other rules name."""
    seen = [_seen(one) for one in joints if one.row not in named]
    for mine in seen:
        others = _Others(mine, [each for each in seen if each is not mine])
        found = next(filter(None, (rule(mine, others) for rule in _RULES)), None)
        if found is not None:
            yield found


def _seen(one: Followed) -> _Seen:
    turns, visits = one.turns(), list(one.visits(_OFF_RAD / 2, _LOAD / 2))
    jerks, swings = one.jerks(), one.swings()
    shown: dict[str, Iterable[float]] = {
        "behind": (turn.behind for turn in turns),
        "stood": (turn.stood for turn in turns),
        "takes": (more for _, _, more in _loaded(turns)),
        "off": (visit.change for visit in visits),
        "load": (visit.load_change for visit in visits),
        "jerk": jerks[np.isfinite(jerks)].tolist(),
        "swings": (float(len(swings)),),
    }
    most = {quantity: max(0.0, max(values, default=0.0)) for quantity, values in shown.items()}
    return _Seen(one, turns, visits, jerks, swings, most)


def _plain(seen: _Seen) -> str:
    return _SIDE.sub("", seen.one.joint.name)


def _turns_badly(mine: _Seen, others: _Others) -> Finding | None:
    one, turns = mine.one, mine.turns
    theirs = others.most("behind")
    least = max(_BEHIND_RAD, _OTHERS * theirs)
    bad = [turn for turn in turns if turn.behind > least]
    if not bad:
        return None
    worst = max(bad, key=lambda turn: turn.behind)
    usual = [turn for turn in turns if turn.at_s < bad[0].at_s and turn.behind < _BEHIND_RAD / 2]
    behind, stood = (float(np.median([turn[at] for turn in bad])) for at in (1, 3))
    theirs_stood = others.most("stood")
    stands = stood > max(_STOOD * behind, _OTHERS * theirs_stood)
    text = f"is {_deg(worst.behind)} behind in both directions{others.beside(theirs)}"
    if stands and (usual or one.alike >= _FEWEST_ALIKE):
        text += f", and stands still at each turn until its goal is {_deg(stood)} back"
        code, takes = _rubs(worst, usual, [turn.load for each in others.all for turn in each.turns])
        return mine.does(code, bad[0].at_s, text + takes)
    late_s, *before_s = (one.lag_s + turn.behind / turn.speed for turn in (worst, *usual))
    once = len(bad) < _FEWEST_TURNS and worst.behind < 2 * least
    if stands or once or not before_s or late_s < max(_SOFTER * max(before_s), max(before_s) + _LATE_S):
        return None
    return mine.does("softer_joint", bad[0].at_s, f"{text}, and was not at its first turns")


def _rubs(worst: Turn, usual: list[Turn], others: list[float]) -> tuple[str, str]:
    """Return what makes a joint stand still at its turns, and the torque that it takes."""
    if math.isnan(worst.load):
        return "lost_motion", ""
    before = max(0.0, usual[0].load if usual else float(np.median(others)))
    compared = f"{before:.0%} {'before' if usual else 'in the others'}"
    rubs = worst.load > max(before + _LOAD, 1.5 * before)
    takes = f", which takes {max(0.0, worst.load):.0%} of its torque ({compared})"
    return ("friction" if rubs else "play"), takes


def _takes_more(mine: _Seen, others: _Others) -> Finding | None:
    theirs = others.most("takes")
    bad = [each for each in _loaded(mine.turns) if each[2] > max(_LOAD, each[1], _OTHERS * theirs)]
    if len(bad) < _FEWEST_TURNS:
        return None
    worst, before, _ = max(bad, key=lambda each: each[2])
    text = f"takes {worst.load:.0%} of its torque in both directions (before: {before:.0%})"
    return mine.does("friction", bad[0][0].at_s, text)


def _loaded(turns: list[Turn]) -> Iterator[tuple[Turn, float, float]]:
    """Yield turns with the most that the movement took before, nearly as fast, and how much more it takes."""
    for at, turn in enumerate(turns):
        before = [each.load for each in turns[:at] if each.speed >= turn.speed / _FASTER]
        if before and not math.isnan(turn.load):
            most = max(0.0, *before[:_FEWEST_TURNS])
            yield turn, most, turn.load - most


def _pulled(mine: _Seen, others: _Others) -> Finding | None:
    visits = mine.visits
    rubs = 2 * max((abs(turn.behind) for turn in mine.turns[:2]), default=0.0)
    theirs = others.most("off")
    least = max(_OFF_RAD, rubs, _OTHERS * theirs)
    off = [each for each in visits if each.change > least]
    theirs_load = others.most("load")
    loaded = [each for each in visits if each.load_change > max(_LOAD, _OTHERS * theirs_load)]
    bad = off if _lasts(off) else loaded
    if not _lasts(bad):
        return None
    since_s = bad[0].at_s
    loads = np.array([(each.load, each.load_was) for each in bad if math.isfinite(each.load_was)])
    load, was = np.median(np.abs(loads), axis=0).tolist() if len(loads) else (math.nan, math.nan)
    grew = np.diff(np.abs(loads)).ravel() if len(loads) else np.zeros(1)
    alike = abs(load - was) > _LOAD / 2 and abs(grew.sum()) >= _ALIKE * np.abs(grew).sum()
    takes = f"takes {load:.0%} of its torque at places where it took {was:.0%} before"
    if alike and load < _NOTHING * was:
        return mine.does("carries_nothing", since_s, takes)
    if bad is loaded:
        return mine.does("off_its_way", since_s, takes) if alike else None
    most = _deg(max(each.change for each in bad))
    text = f"is off by up to {most} more than before at the same places{others.beside(theirs)}"
    side = _one_side(bad, [each for each in visits if each.at_s > since_s and each.change < least / 2])
    text += f", the more the further it goes {side}" if side else ""
    text += f", with {load:.0%} of its torque instead of {was:.0%}" if alike else ""
    return mine.does("pulled_joint" if side else "off_its_way", since_s, text)


def _lasts(visits: list[Visit]) -> bool:
    return len(visits) >= _FEWEST_VISITS and sum(each.seconds for each in visits) >= _PULLED_S


def _one_side(bad: list[Visit], good: list[Visit]) -> str:
    """Return on which side of what the places are where a joint is off; empty: on no side, or on both."""
    if len(good) < _FEWEST_VISITS:
        return ""
    places, off = np.array([(each.place, each.off - each.was) for each in bad]).T
    sound = np.array([each.place for each in good])
    if np.ptp(places) < STROKE_RAD or abs(off.sum()) < 0.9 * np.abs(off).sum():
        return ""
    along = float(np.corrcoef(places, np.abs(off))[0, 1])
    above, below = np.median(places) > np.quantile(sound, 0.9), np.median(places) < np.quantile(sound, 0.1)
    if above and along > _ALONG:
        return f"beyond {math.degrees(places.min()):.0f} deg"
    return f"below {math.degrees(places.max()):.0f} deg" if below and along < -_ALONG else ""


def _jerked(mine: _Seen, others: _Others) -> Finding | None:
    one, jerks = mine.one, mine.jerks
    theirs = others.most("jerk")
    times = one.at_s[np.nan_to_num(jerks) > max(_JERK_RAD, _OTHERS * theirs)]
    count = int((np.diff(times, prepend=-math.inf) > _APART_S).sum())
    if count < _JERKS:
        return None
    most = _deg(float(np.nanmax(jerks)))
    text = f"is thrown off its way {count} times while its goals are even, by up to {most} within 80 ms"
    return mine.does("jerked_joint", float(times[0]), text + others.beside(theirs))


def _hunts(mine: _Seen, others: _Others) -> Finding | None:
    at_s = mine.swings
    theirs = others.most("swings")
    if len(at_s) < max(_SWINGS, _OTHERS * theirs):
        return None
    hertz = (len(at_s) - 1) / float(at_s[-1] - at_s[0]) / 2
    text = f"swings to and fro around its goal {hertz:.0f} times a second, {len(at_s) // 2} times in a row"
    return mine.does("hunting_joint", float(at_s[0]), text)


def _deg(rad: float) -> str:
    return f"{math.degrees(rad):.1f} deg"


_RULES = (_turns_badly, _takes_more, _hunts, _pulled, _jerked)  # The most direct evidence first
