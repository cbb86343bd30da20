"""The kinds of what joints do wrongly: what is said of each, how severe it is, and what helps."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dxlrun.description.units import distance_text
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.failing import (
    AWAY,
    AWAY_RAD,
    BAD_S,
    ERROR,
    GOALS,
    LOAD,
    POSITION,
    SPEED,
    STILL_RAD,
    SWINGS,
    Failing,
    Windows,
)
from dxlrun_analysis.joints.planned import PlannedJoint

Says = Callable[[Windows, Failing, float], str]
"""Returns what one did, by its windows, the failing, and the usual error of the others."""


class Kind(NamedTuple):
    """One kind of finding about the movement of a joint."""

    remedy: str
    says: Says | None = None  # None: the rule that finds it says it itself
    may_be: str = ""  # What it may come from, behind the sentence
    rank: Rank = Rank.SERVO  # Where it lasted for a second or more
    share: float = 3.0
    shared: bool = False  # A joint that is not at fault may show it too, where others do
    of_replies: bool = False  # Where replies are spoilt, goals wait, and joints do it that are not at fault
    commanded: bool = False  # Its commands are the matter, whatever its servo is


def finding_of(one: Windows, failing: Failing, others: float) -> Finding:
    """Return the finding about a joint; `others`: their usual error, NaN where it is not known."""
    kind, when = KINDS[failing.code], failing.when
    away = when & (one.mean[AWAY] > AWAY_RAD * one.joint.share)  # it may have stood where it was to stand
    since_s = float(np.flatnonzero(away if away.any() else when)[0]) * one.length_s
    text = kind.says(one, failing, others) if kind.says else ""
    return finding(failing.code, one.joint, text, since_s, brief=failing.seconds < BAD_S)


def finding(code: str, joint: PlannedJoint, text: str, since_s: float, *, brief: bool = False) -> Finding:
    """Return the finding of a kind about a joint; `text`: what it does, `brief`: for less than a second."""
    kind = KINDS[code]
    name = joint.name if kind.commanded else f"{joint.name} ({joint.servos})"
    sentence = f"{name} {text}; from {since_s:.1f} s of the run on{kind.may_be}."
    rank = max(kind.rank, Rank.CAUSE) if brief else kind.rank
    return Finding(code, joint.name, sentence, kind.remedy, rank, kind.share)


def distance(joint: PlannedJoint, way: float) -> str:
    """Return a distance of a joint in the unit of its kind."""
    return distance_text(way, joint.logged.linear, digits=1)


# What is said of each


def _part(one: Windows, failing: Failing) -> str:
    return f"and went {one.moved(failing.when):.0%} of its way"


def _away(one: Windows, failing: Failing) -> str:
    return distance(one.joint, one.typical(AWAY, failing.when))


def _exerted(one: Windows, failing: Failing) -> str:
    load = one.typical(LOAD, failing.when)
    if math.isnan(load):
        return "; its load is not read"
    usual = one.typical(LOAD, failing.usual & (one.mean[SPEED] > 0))
    otherwise = "" if math.isnan(usual) else f", {usual / one.joint.top_effort:.0%} otherwise"
    return f" ({load / one.joint.top_effort:.0%} of its torque{otherwise})"


def _limited_torque(one: Windows, failing: Failing, others: float) -> str:
    most = np.nanquantile(one.most[LOAD, failing.when], 0.9) / one.joint.top_effort
    away, part = _away(one, failing), _part(one, failing)
    limited = ": its torque is limited, or its gain is low"
    return f"exerted no more than {most:.0%} of its torque, {away} from its goal, {part}{limited}"


def _limited_speed(one: Windows, failing: Failing, others: float) -> str:
    steps = np.abs(np.diff(one.mean[POSITION], prepend=np.nan))[failing.when]
    speed = distance(one.joint, np.nanquantile(steps, 0.9) / one.length_s)
    text = f"moved at no more than {speed}/s, {_away(one, failing)} from its goal, {_part(one, failing)}"
    return f"{text}{_exerted(one, failing)}: its speed or its torque is limited, or it is stiff"


def _far(one: Windows, failing: Failing, others: float) -> str:
    text = f"was {_away(one, failing)} from its goal for {failing.seconds:.1f} s, {_part(one, failing)}"
    return text + _exerted(one, failing)


def _worse(one: Windows, failing: Failing, others: float) -> str:
    if one.reach(POSITION, failing.when) <= STILL_RAD * one.joint.share:
        return _still(one, failing, others)
    error, before = one.typical(AWAY, failing.when), one.typical(AWAY, failing.usual)
    worse = f"{error / before:.0f} times worse" if before > one.joint.tick else "worse"
    rest = "" if math.isnan(others) else f"; other joints: {distance(one.joint, others)}"
    compared = f"(before: {distance(one.joint, before)}{rest})"
    text = f"followed {worse} than before: {_away(one, failing)} away {compared}, {_part(one, failing)}"
    return text + _exerted(one, failing)


def _commanded(one: Windows, failing: Failing, others: float) -> str:
    hertz = one.typical(GOALS, failing.when) / 2
    text = f"is sent to and fro {hertz:.0f} times a second by its commands, and is {_away(one, failing)}"
    return f"{text} from them on average"


def _shakes(one: Windows, failing: Failing, others: float) -> str:
    hertz = one.typical(SWINGS, failing.when) / 2
    text = f"shakes {hertz:.0f} times a second around its goal"
    if math.isnan(one.typical(AWAY, failing.when)):
        return f"{text}, to which a controller moves it with an effort"
    return f"{text}, {_away(one, failing)} on average{_exerted(one, failing)}"


def _still(one: Windows, failing: Failing, others: float, how: str = "") -> str:
    when = failing.when
    most = np.nanmax(np.abs([one.least[ERROR, when], one.most[ERROR, when]]))
    away = distance(one.joint, float(most))
    text = f"stood still{how} for {failing.seconds:.1f} s although its goal was up to {away} away"
    return text + _exerted(one, failing)


def _still_at(one: Windows, failing: Failing, how: str) -> str:
    place = distance(one.joint, float(np.nanmedian(one.mean[POSITION, failing.when])))
    return _still(one, failing, math.nan, how.format(place))


_LOOK = "`dxlrun servo PORT ID get`"
KINDS = {
    "jammed_joint": Kind(
        "Look for what blocks it: an obstacle, a cable in the joint, a broken gear.",
        lambda one, failing, others: _still_at(one, failing, " at {}, as if blocked,"),
        rank=Rank.SERVO_CAUSE,  # it may pull down the supply, or shut itself down
    ),
    "frozen_position": Kind(
        "Turn it by hand without torque: a position that does not change then is the encoder's or the "
        f"servo's mistake. Else compare torque, mode and limits with the robot file ({_LOOK}): another "
        "program may have changed them.",
        lambda one, failing, others: _still_at(one, failing, ", to the tick,"),
        ": what it reads is not its position, or it does not try: without torque, in another mode or at a "
        "limit of its own",
    ),
    "goes_no_further": Kind(
        "Compare Max and Min Position Limit (CW and CCW Angle Limit) with the robot file "
        f"({_LOOK}), and look for what it runs into there.",
        lambda one, failing, others: _still_at(one, failing, " at {} each time,"),
    ),
    "speed_limit": Kind(
        "Compare Profile Velocity (Moving Speed), Torque Limit and Goal PWM with the model's: "
        f"{_LOOK} prints them; another tool may have left them.",
        _limited_speed,
        shared=True,
    ),
    "torque_limit": Kind(
        f"Compare Torque Limit, Goal Current, Goal PWM and gains with the model's: {_LOOK} prints them.",
        _limited_torque,
        shared=True,
    ),
    "far_from_goal": Kind(
        "Look for what holds it back: an obstacle, friction, too heavy a load, low gains or limits "
        f"({_LOOK}).",
        _far,
        shared=True,
        of_replies=True,
    ),
    "joint_shakes": Kind(
        "Look for play in gears and horn; lower the gains of servo and controller, or its load's inertia.",
        _shakes,
        of_replies=True,
    ),
    "goal_swings": Kind(
        "See which clients and controllers command it (`/commands` in the log), and let only one.",
        _commanded,
        rank=Rank.CAUSE,
        commanded=True,
    ),
    "error_grew": Kind(
        f"Compare its gains and limits with the model's ({_LOOK}), and turn it by hand: a horn or a gear may "
        "slip.",
        _worse,
        shared=True,
        of_replies=True,
    ),
    "position_jumped": Kind(
        "Turn it by hand without torque and watch its position; compare Homing Offset and Drive Mode with "
        f"the robot file ({_LOOK}).",
        may_be=": a gear or horn slips, its encoder is loose, or another tool changed its offset or "
        "direction",
        rank=Rank.CAUSE,
        share=4.0,
    ),
    "friction": Kind(
        "Turn it by hand without torque, and feel for where it is stiff: its bearing, its gear, a cable.",
        may_be=": something rubs, as in a dry bearing",
        rank=Rank.CAUSE,
    ),
    "play": Kind(
        "Hold its servo and turn it by hand: see whether horn, screws or gear have play.",
        may_be=": something gives first, as a worn gear or a loose horn",
        rank=Rank.CAUSE,
    ),
    "lost_motion": Kind(
        "Turn it by hand without torque: see whether horn or gear have play, and where it is stiff.",
        may_be=": there is play, as of a worn gear, or friction, as of a dry bearing",
        rank=Rank.CAUSE,
    ),
    "softer_joint": Kind(
        f"Compare its gains and limits with the model's ({_LOOK}), and turn it by hand.",
        may_be=": its gain, its torque or its supply fell, or something damps it",
        rank=Rank.CAUSE,
    ),
    "carries_nothing": Kind(
        "See whether its load was taken off; else whether its horn or its gear slips.",
        may_be=": its load was taken off, or its horn slips",
        rank=Rank.REMARK,
    ),
    "pulled_joint": Kind(
        "Look for what pulls or presses there: a cable, a spring, a part in its way.",
        may_be=": it is held back there, as by a spring or a cable",
        rank=Rank.REMARK,
    ),
    "off_its_way": Kind(
        "Look at what it carries and touches, and at its gains.",
        may_be=": its load changed, or how it holds it",
        rank=Rank.REMARK,
    ),
    "hunting_joint": Kind(
        "Lower its gains, or those of its controller; look for play in gears and horn.",
        may_be=": it swings by itself",
        rank=Rank.REMARK,
    ),
    "jerked_joint": Kind(
        "Look at what its limb touches, and for play in horn and gear.",
        may_be=": its load comes and goes at once, as where a foot slips",
        rank=Rank.REMARK,
    ),
}
MOVES_WORSE = frozenset(code for code, kind in KINDS.items() if kind.of_replies)
"""What joints do that are not at fault, where replies are spoilt."""
COMMANDED = frozenset(code for code, kind in KINDS.items() if kind.commanded)
