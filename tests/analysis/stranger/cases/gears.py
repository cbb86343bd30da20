"""Motors, gears, bearings and encoders that fail, and loads that are more than a joint can bear."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from tests.analysis.stranger.expectation import (
    BUSES,
    FOLLOWS,
    HEAT,
    LATE,
    LOAD,
    OPPOSED,
    SHAKES,
    STUCK,
    WEAK,
    Case,
    collector,
    others,
    together,
)
from tests.analysis.stranger.kit import JOINTS, KNEES, Story, stronger
from tests.analysis.stranger.proof import column, lags, load_changes, said, seen
from tests.analysis.stranger.world import carry, heats, noisy_imu, poke, rubs, shove, transmits

from dxlrun.log.reader import Log

CASES: list[Case] = []
case = collector(CASES)


def tick_rad(story: Story) -> float:
    """Return how far a robot's servos turn in a tick, rad."""
    return 0.00511 if story.kind.name.startswith("ax") else 0.001534


# Motors and control


@case(
    "movement",
    "mx_bulk x_fast",
    subject=("left_elbow",),
    cause=STUCK + r"|" + WEAK + r"|motor|dead|no (power|torque|current)",
    good=False,
)
def motor_is_dead(story: Story) -> None:
    """A brush of an elbow's motor breaks off: the servo answers, has torque enabled and no error, and its
    self-locking gear stands still where it is while the goal goes on by 25 degrees to both sides."""
    story.motion = story.swing(left_elbow="0.45 * sin(2.3 * t)")
    story.never_overloads("left_elbow")
    story.at(2.6, lambda: story.weaken("left_elbow", 0.001), "left_elbow")
    rubs(story, "left_elbow", lambda t_s, q, dq: 3.0 if t_s > 2.6 else 0.0, "self-locking")
    lags(story, "left_elbow", 0.3, 2.7)


@case("movement", "mx_bulk x_three", subject=("left_elbow",), cause=r"gain|" + WEAK)
def gain_fades(story: Story) -> None:
    """From the first second on a program halves the gain of an elbow each 0.6 s, down to a tenth: the
    elbow, which carries a forearm, follows worse and worse."""
    story.joint("left_elbow")["simulation"]["gravity"] = "0.8 Nm"
    story.motion = story.swing(left_elbow="0.6 + 0.35 * sin(2.2 * t)")
    first: list[int] = []

    def fade(t_s: float) -> None:
        servo = story.servo("left_elbow")
        item = "p_gain" if story.kind.protocol == 1.0 else "position_p_gain"
        first[:] = first or [servo.registers[item]]
        poke(story, "left_elbow", **{item: max(first[0] // 10, servo.registers[item] // 2, 1)})

    story.every(0.6, fade, "left_elbow", since_s=0.9)
    lags(story, "left_elbow", 0.09, 2.0)


@case("movement", "mx_bulk x_fast", subject=("head_yaw",), cause=SHAKES + r"|gain|" + FOLLOWS)
def neck_hunts(story: Story) -> None:
    """In the run the gains of a neck come into the wrong fields, a small P and a huge I: the head hunts about
    its goal by many degrees, faster than any goal, and never comes to rest."""
    story.joint("head_yaw")["simulation"]["inertia"] = f"{stronger(story, 0.01, 0.02)} kg m^2"
    story.motion = story.swing(head_yaw="0.35 * sin(1.2 * t)")
    story.never_overloads("head_yaw")

    def tune() -> None:
        poke(story, "head_yaw", p_gain=6, d_gain=0, i_gain=200)
        poke(story, "head_yaw", position_p_gain=150, position_d_gain=0, position_i_gain=12000)

    story.at(2.2, tune, "head_yaw")

    def check(log: Log) -> None:
        off = column(log, "goal_position", "head_yaw", 2.6) - column(log, "position", "head_yaw", 2.6)
        signs = off[np.abs(off) > 0.04] > 0
        story.evidence["turns"] += int(np.count_nonzero(signs[1:] != signs[:-1]))

    story.checks.append(check)
    story.at_end(lambda: story.evidence["turns"] > 6, "hunts")
    lags(story, "head_yaw", 0.1, 2.6)


@case(
    "movement",
    "mx_two x_fast",
    subject=("left_shoulder",),
    cause=HEAT + r"|limit|PWM|" + WEAK,
)
def derates_when_hot(story: Story) -> None:
    """A shoulder gets hot under its arm, and its firmware takes back its torque step by step from 55
    degrees C on: at 75 degrees it holds a tenth and sinks."""
    story.joint("left_shoulder")["simulation"]["gravity"] = f"{stronger(story, 1.0, 1.6)} Nm"
    story.motion = story.swing(left_shoulder="0.8 + 0.3 * sin(1.7 * t)")
    story.never_overloads("left_shoulder")
    heats(story, "left_shoulder", lambda t_s: min(76.0, 42.0 + 9.0 * (t_s - 0.5)))

    def derate(t_s: float) -> None:
        share = min(1.0, max(0.08, 1.0 - (story.servo("left_shoulder").temperature - 55.0) / 20.0))
        poke(story, "left_shoulder", torque_limit=round(1023 * share), goal_pwm=round(885 * share))

    story.every(0.2, derate, "left_shoulder", 1.0)
    seen(story, "temperature", "left_shoulder", lambda values: np.nanmax(values) > 70)
    lags(story, "left_shoulder", 0.15, 3.5)


@case(
    "servo",
    "mx_bulk x_fast",
    cause=together(KNEES, HEAT + r"|shut|limp|no torque|lost its torque|overheat"),
    innocents=others(*KNEES),
    good=False,
)
def knees_trip_one_after_the_other(story: Story) -> None:
    """After a long match both knees are hot: first the left one reaches its limit of temperature and switches
    itself off, a second later the right one."""
    heats(story, "left_knee", lambda t_s: min(88.0, 66.0 + 7.5 * (t_s - 0.5)), trips=True)
    heats(story, "right_knee", lambda t_s: min(88.0, 60.0 + 7.0 * (t_s - 0.5)), trips=True)
    story.at_end(lambda: story.was_on("left_knee", 1.5) and story.was_on("right_knee", 1.5), "held")
    story.at_end(lambda: not story.was_on("left_knee", 5.0), "left is limp")
    story.at_end(lambda: not story.was_on("right_knee", 5.5), "right is limp")


# Bearings, gears and springs


@case("movement", "ax_single x_three", subject=("right_elbow",), cause=OPPOSED + "|" + LATE)
def tight_spot(story: Story) -> None:
    """A bearing has a tight spot: between 3 and 15 degrees an elbow needs nearly all its torque to get on and
    lags behind by many degrees, elsewhere it turns easily."""
    most = stronger(story, 1.05, 3.4)
    story.motion = story.swing(right_elbow="0.45 * sin(2.2 * t)")
    story.never_overloads("right_elbow")
    rubs(story, "right_elbow", lambda t_s, q, dq: most if t_s > 1.2 and 0.05 < q < 0.26 else 0.0, "tight")
    lags(story, "right_elbow", 0.09, 1.3)


@case(
    "movement",
    "mx_bulk x_three",
    subject=("right_shoulder",),
    cause=OPPOSED + r"|stick|slip|jerk|jump|twitch|step|" + SHAKES,
)
def sticks_and_slips(story: Story) -> None:
    """Sand in a bearing: a shoulder sticks until its servo pulls with nearly all it has, then breaks loose
    and jumps by several degrees, sticks again, and so on, from midway to the end."""
    most = stronger(story, 2.1, 3.5)
    story.motion = story.swing(right_shoulder="0.55 * sin(1.5 * t)")
    story.never_overloads("right_shoulder")
    rubs(
        story,
        "right_shoulder",
        lambda t_s, q, dq: most if t_s > 2.3 and abs(dq) < 0.1 else 0.0,
        "sticks",
    )
    lags(story, "right_shoulder", 0.087, 2.4)


@case(
    "movement",
    "ax_single x_fast",
    subject=("left_shoulder",),
    cause=r"backlash|\bplay\b|slack|hystere|dead ?(band|zone)|loose|revers|lost motion|" + WEAK + "|" + STUCK,
)
def play_grows(story: Story) -> None:
    """The screws of a horn come loose bit by bit: a shoulder's play grows from nothing to 14 degrees within
    the run, and after each reversal the output lags until the play is through."""
    at: list[float] = []

    def behind(show: Callable[[], int]) -> int:
        now = show()
        half = 0.122 / tick_rad(story) * min(1.0, (story.now_s("left_shoulder") - 1.2) / 3.0)
        at[:] = [min(now + half, max(now - half, at[0] if at else now))]
        story.evidence["behind"] += at[0] != now
        return round(at[0])

    story.motion = story.swing(left_shoulder="0.45 * sin(3.1 * t)")
    story.shown("left_shoulder", "present_position", behind, 1.2)
    lags(story, "left_shoulder", 0.1, 2.0)


@case(
    "movement",
    "mx_two x_fast",
    subject=("left_shoulder",),
    cause=r"slip|gear|tooth|teeth|clutch|one (way|side|direction)|" + WEAK + "|" + STUCK,
)
def gear_holds_one_way_only(story: Story) -> None:
    """The flanks of a gear are worn on one side: what a shoulder's motor gives upward slips through from
    midway on but for a fifteenth, downward the gear holds; the arm sinks and is not lifted any more."""
    story.joint("left_shoulder")["simulation"]["gravity"] = f"{stronger(story, 0.6, 1.0)} Nm"
    story.motion = story.swing(left_shoulder="0.4 + 0.4 * sin(2.1 * t)")
    story.never_overloads("left_shoulder")
    transmits(story, "left_shoulder", lambda t_s, nm: nm / 15 if t_s > 2.5 and nm > 0 else nm, "slips")
    lags(story, "left_shoulder", 0.2, 2.6)


@case("movement", "mx_two x_fast", subject=("right_shoulder",), cause=OPPOSED + r"|gravity|heavier|chang")
def counter_spring_breaks(story: Story) -> None:
    """A spring carries nine tenths of a heavy arm, as designed; it breaks midway with a bang, and from then
    on the shoulder bears the whole arm and hangs by several degrees."""
    weight = stronger(story, 2.6, 4.6)
    story.joint("right_shoulder")["simulation"]["gravity"] = f"{weight} Nm"
    story.motion = story.swing(right_shoulder="0.75 + 0.25 * sin(1.8 * t)")
    story.never_overloads("right_shoulder")

    def spring(t_s: float, q: float, dq: float) -> float:
        story.evidence["broken"] += t_s >= 3.0
        return 0.9 * weight * math.sin(q) if t_s < 3.0 else 0.0

    shove(story, "right_shoulder", spring, "spring")

    load_changes(story, "right_shoulder", "heavier", 3.0, lambda before, after: after > 3 * before)
    lags(story, "right_shoulder", 0.087, 3.1)


# Encoders


@case(
    "movement",
    "ax_single x_fast",
    subject=("right_shoulder",),
    cause=STUCK + r"|encoder|potentiometer|jump|leap|implaus|unchang|constant|no longer chang|" + FOLLOWS,
)
def encoder_hangs_for_a_moment(story: Story) -> None:
    """A shoulder's position sensor hangs for 1.3 s: the position stands to the tick and the speed is 0, while
    its goal goes on by many degrees; then the readings are right again."""
    story.motion = story.swing(right_shoulder="0.5 * sin(2.3 * t)")
    kept: dict[str, int] = {}

    def hangs(name: str, show: Any) -> int:
        if story.now_s("right_shoulder") > 3.7:
            return int(show())
        story.evidence["hangs"] += 1
        return kept.setdefault(name, 0 if name == "present_velocity" else int(show()))

    for item in ("present_position", "present_velocity"):
        story.shown("right_shoulder", item, lambda show, item=item: hangs(item, show), 2.4)
    lags(story, "right_shoulder", 0.2, 2.4)


@case(
    "movement",
    "ax_single x_fast",
    subject=("left_knee",),
    cause=r"drift|offset|shift|encoder|potentiometer|reference|zero|creep|" + FOLLOWS + "|" + LOAD,
)
def reference_creeps(story: Story) -> None:
    """The magnet of a knee's encoder turns slowly on its shaft: what the knee shows creeps away from where it
    is told to be, by 5 degrees a second, up to 15 degrees; the motion goes on."""

    def crept(show: Callable[[], int]) -> int:
        by = min(0.26, 0.087 * (story.now_s("left_knee") - 2.0))
        story.evidence["crept"] += by > 0
        return max(0, show() + round(by / tick_rad(story)))

    story.shown("left_knee", "present_position", crept, 2.0)
    lags(story, "left_knee", 0.2, 3.0)


# Loads


@case(
    "robot",
    "ax_single x_fast",
    subject=("right_shoulder",),
    cause=r"overload|limp|no torque|lost its torque|shut|" + WEAK,
    good=False,
)
def lifts_until_it_trips(story: Story) -> None:
    """A full bucket is hung on a raised arm: it is more than the shoulder can hold, it gives way, and
    after a second its overload protection trips and it is limp."""
    story.motion = story.swing(right_shoulder="0.9 + 0.25 * sin(1.5 * t)")
    bucket = 4.0 if story.kind.protocol == 1.0 else 8.0
    story.at(2.3, lambda: carry(story, "right_shoulder", bucket), "right_shoulder")
    story.at_end(lambda: story.servo("right_shoulder").overload, "tripped")
    lags(story, "right_shoulder", 0.2, 2.3)


@case(
    "robot",
    "mx_two x_fast",
    subject=("right_knee",),
    cause=r"\bfell|fall(s|en)?\b|tipped|reflex|takes? over|took over|" + WEAK,
    first=2,
)
def falls_as_a_knee_gives_way(story: Story) -> None:
    """The gear of a knee wears through under the robot's weight: the knee has torque and goals and gives way
    all the same, the robot falls, and the reflex takes over."""
    story.upright("right_knee")
    noisy_imu(story)
    story.motion = story.swing(right_knee="0.2 * sin(1.1 * t)")
    story.joint("right_knee")["simulation"].update(gravity="4 Nm", gravity_angle="180 deg")
    story.never_overloads("right_knee")
    story.at(2.7, lambda: story.weaken("right_knee", 0.02), "right_knee")
    lags(story, "right_knee", 0.3, 2.7)


@case(
    "robot",
    "ax_single x_fast",
    subject=("left_elbow",),
    cause=r"abort|not reach|did not reach|\bmiss|short of|toleran|goal time|too (fast"
    r"|soon|late|far)|speed|veloc|" + FOLLOWS,
    innocents=(*others("left_elbow"), *BUSES, "hardware"),
)
def asked_too_much_too_soon(story: Story) -> None:
    """A client wants an elbow that holds a racket 85 degrees further within a quarter of a second, which it
    cannot: it gets there too late, and the goal is given up. Nothing is broken."""
    story.play()
    story.spec["controllers"]["body"]["tolerances"] = {"goal": "3 deg", "goal_time": "60 ms"}
    goal = [1.5 if joint == "left_elbow" else 0.0 for joint in JOINTS]
    there = {"points": [{"time": 0.26, "positions": goal}]}
    story.joint("left_elbow")["simulation"]["inertia"] = "0.03 kg m^2"
    story.asks.append((2.4, "body", "trajectory", there))
    said(story, "missed")
    lags(story, "left_elbow", 0.4, 2.4)
