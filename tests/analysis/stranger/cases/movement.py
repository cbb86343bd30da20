"""Joints that do not do what they are told."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from tests.analysis.stranger.expectation import LATE, SOFT, STUCK, Case, collector
from tests.analysis.stranger.kit import S, Story, freeze
from tests.analysis.stranger.proof import column, lags
from tests.analysis.stranger.world import late_wakes, poke, read_slowly, shove, voltages_often

from dxlrun.log.reader import Log

CASES: list[Case] = []
case = collector(CASES)

OPPOSED = (
    rf"{SOFT}|{STUCK}|load|force|effort|current|pull|push|friction|stiff|heav|drag|resist|spring|contact|outside|"
    r"strain|overload|torque"
)
"""Something works against the joint, or it does not get where it should."""


@case("movement", "mx_bulk x_fast ax_single", subject=("left_elbow",), cause=STUCK, good=False)
def encoder_frozen(story: Story) -> None:
    """The encoder of an elbow freezes: position to the tick the same, speed 0, while its goal goes on."""
    freeze(story, "left_elbow", 2.4, "present_position")
    story.shown("left_elbow", "present_velocity", lambda show: 0, 2.4)
    story.frozen("left_elbow", 2.5)


@case("movement", "mx_bulk x_fast", subject=("left_knee",), cause=r"volt|supply|sag|power|brown")
def own_supply_sags(story: Story) -> None:
    """The power plug of one knee has corroded: its own voltage falls with its load, that of no other does."""
    voltages_often(story)
    story.joint("left_knee")["simulation"].update(gravity="1.3 Nm", gravity_angle="-90 deg")

    def sag(t_s: float) -> None:
        servo = story.servo("left_knee")
        servo.advance(story.bus("left_knee").now_ns)
        servo.voltage = max(10.2, 12.0 - 7.0 * abs(servo.shaft.duty * servo.shaft.current))
        story.evidence["sagged"] += servo.voltage < 10.8
        servo.protect()

    story.every(0.01, sag, "left_knee", since_s=1.0)


@case(
    "movement",
    "x_three ax_single",
    subject=("right_elbow",),
    cause=r"slip|jump|implaus|gear|sudden|follow|error|off\b",
)
def gear_jumps_a_tooth(story: Story) -> None:
    """A worn gear lets the joint slip by 20 degrees under load, several times; the servo brings it back."""

    def slip(t_s: float) -> None:
        servo = story.servo("right_elbow")
        servo.shaft.mechanics.place(servo.shaft.index, servo.position + 0.35)
        story.evidence["slip"] += 1

    story.every(0.6, slip, "right_elbow", since_s=2.3)


@case("movement", "x_fast mx_two ax_single", subject=("right_knee",), cause=STUCK + r"|behind|limited")
def blocked_without_load(story: Story) -> None:
    """A knee is blocked by a cable tie, while its servo gives next to no torque, as its limit is low."""
    item = ("goal_pwm", 60) if story.kind.protocol == 2 else ("torque_limit", 70)
    story.at(1.0, lambda: story.servo("right_knee").poke(*item), "right_knee")
    story.never_overloads("right_knee")
    story.fault("jam servo={id} at=2400ms", "right_knee")


@case("movement", "ax_single x_sync", subject=("left_knee",), cause=LATE + r"|hot|warm|temperature")
def late_when_hot(story: Story) -> None:
    """A knee warms up in the run; above 55 degrees its replies come late, more and more."""
    read_slowly(story)

    def warm(t_s: float) -> None:
        story.servo("left_knee").temperature = 32 + 7.5 * (t_s - 1)

    story.every(0.1, warm, "left_knee", since_s=1.0)

    def late(t_s: float) -> tuple[Any, float] | None:
        hot = story.servo("left_knee").temperature - 52
        return (bytes, 0.0006 * hot) if hot > 0 else None

    story.alter("left_knee", late, "late and hot")


@case(
    "movement",
    "x_fast x_sync",
    subject=("left_elbow",),
    cause=r"jump|implaus|revers|direction|drive mode|position|sign|mirror",
)
def counts_backwards(story: Story) -> None:
    """Another tool flips the direction of one servo midway: the same shaft is read with the other sign."""
    story.at(2.4, lambda: story.flip("left_elbow"), "left_elbow")


@case(
    "movement",
    "x_fast ax_single mx_two",
    subject=("head_yaw",),
    cause=r"jump|implaus|slip|offset|sudden|shift|\boff\b|error",
)
def encoder_shifts(story: Story) -> None:
    """The magnet of a neck's encoder slips by 25 degrees in a knock; the servo turns until it reads its
    goal again."""

    def shift() -> None:
        servo = story.servo("head_yaw")
        servo.shaft.mechanics.place(servo.shaft.index, servo.position + 0.43)
        story.evidence["shift"] += 1

    story.at(2.8, shift, "head_yaw")


@case(
    "movement",
    "ax_single x_fast mx_bulk",
    subject=("left_shoulder",),
    cause=SOFT + r"|torque|limit|PWM|stuck|still",
)
def torque_limit_lowered(story: Story) -> None:
    """Another tool lowers the torque limit of a shoulder midway: it sinks under the weight of the arm."""
    story.never_overloads("left_shoulder")
    story.joint("left_shoulder")["simulation"].update(gravity="0.5 Nm", gravity_angle="-80 deg")

    def lower() -> None:
        servo = story.servo("left_shoulder")
        item, value = ("goal_pwm", 45) if "goal_pwm" in servo.registers else ("torque_limit", 60)
        servo.poke(item, value)
        story.evidence["limit"] += 1

    story.at(2.5, lower, "left_shoulder")


@case(
    "movement",
    "x_fast mx_bulk ax_single",
    subject=("left_knee",),
    cause=r"\bhot\b|temperature|heat|warm|deg ?C",
)
def knee_gets_hot(story: Story) -> None:
    """A knee carries too much for long, and gets hotter and hotter until it trips."""
    read_slowly(story)

    def warm(t_s: float) -> None:
        servo = story.servo("left_knee")
        servo.temperature = 55 + 9.0 * (t_s - 1)
        servo.protect()
        story.evidence["warm"] += 1

    story.every(0.1, warm, "left_knee", since_s=1.0)


@case("movement", "x_fast mx_bulk ax_single", subject=("right_shoulder",), cause=SOFT)
def gain_lost(story: Story) -> None:
    """Another tool sets the gain of one servo to a small part, midway; the joint follows softly from then
    on."""
    story.joint("right_shoulder")["simulation"]["gravity"] = "0.3 Nm"

    def soften() -> None:
        servo = story.servo("right_shoulder")
        for item in ("position_p_gain", "p_gain", "ccw_compliance_slope", "cw_compliance_slope"):
            if item in servo.registers:
                servo.poke(item, 128 if "slope" in item else max(1, servo.registers[item] // 12))
                story.evidence["gain"] += 1

    story.at(2.8, soften, "right_shoulder")


@case("movement", "x_sync ax_single", subject=("right_elbow",), cause=LATE)
def late_at_an_angle(story: Story) -> None:
    """The cable of an elbow is pinched at one angle: there its replies come milliseconds late."""
    story.alter(
        "right_elbow",
        lambda t_s: (bytes, 0.004) if t_s > 1 and story.q("right_elbow") > 0.12 else None,
        "late at an angle",
    )


@case("movement", "x_sync mx_two", subject=("left_knee",), cause=STUCK, good=False)
def servo_answers_old_states(story: Story) -> None:
    """The firmware of a knee hangs in part: it answers each read at once, always with the same state."""
    freeze(story, "left_knee", 2.2, "present_position", "present_velocity", story.load_item("left_knee"))
    story.frozen("left_knee", 2.3)


@case(
    "movement",
    "mx_bulk x_sync x_three",
    subject=("left_shoulder",),
    cause=SOFT + r"|slip|gear|stuck|still|stand",
)
def gear_slips_through(story: Story) -> None:
    """The clutch of a shoulder wears out midway: a fiftieth of the motor's torque arrives at the output."""
    story.never_overloads("left_shoulder")
    story.joint("left_shoulder")["simulation"].update(gravity="0.25 Nm", gravity_angle="-40 deg")
    story.at(2.6, lambda: story.weaken("left_shoulder", 0.02), "left_shoulder")


@case("movement", "ax_single x_three", subject=("left_elbow",), cause=STUCK)
def runs_into_a_wall(story: Story) -> None:
    """An elbow runs into a table and pushes for two seconds, then is free again."""
    story.fault("jam servo={id} at=2300ms for=900ms", "left_elbow")


@case(
    "movement",
    "x_fast mx_bulk ax_single",
    subject=("right_shoulder",),
    cause=SOFT + r"|slow|friction|heavy|stiff",
)
def stiff_grease(story: Story) -> None:
    """A bearing seizes up: from midway on a shoulder turns as if in tar."""

    def seize() -> None:
        servo = story.servo("right_shoulder")
        mechanics, index = servo.shaft.mechanics, servo.shaft.index
        mechanics.law._motor_damping[index] *= 25
        mechanics._wake()
        story.evidence["stiff"] += 1

    story.motion = story.swing(right_shoulder="0.6 * sin(2.6 * t)")
    story.at(2.7, seize, "right_shoulder")


@case(
    "movement", "mx_bulk x_three", subject=("right_knee",), cause=SOFT + r"|play|backlash|loose|slack|hyster"
)
def backlash(story: Story) -> None:
    """The horn of a knee has come loose: it has 12 degrees of play, so the joint lags at every reversal."""
    play = 0.1
    held: list[float] = []
    tick = 0.00153398

    def slack(show: Callable[[], int]) -> int:
        shaft = show() * tick
        if not held:
            held.append(shaft)
        held[0] = min(max(held[0], shaft - play), shaft + play)
        story.evidence["slack"] += held[0] != shaft
        return round(held[0] / tick)

    story.shown("right_knee", "present_position", slack, 2.0)


@case(
    "movement",
    "x_fast mx_bulk",
    subject=("right_elbow",),
    cause=r"shak|oscill|vibrat|swing|hunt|trembl|jitter|rough|nois|follow|error|\boff\b",
)
def joint_shakes(story: Story) -> None:
    """An elbow hunts around its goal with a cracked gear: it shakes by degrees at 12 Hz."""
    story.never_overloads("right_elbow")

    def kick(t_s: float) -> None:
        servo = story.servo("right_elbow")
        plant = servo.shaft.mechanics.plant
        plant.velocity[servo.shaft.index] += 3.0 * (1 if int(t_s * 25) % 2 else -1)
        servo.shaft.mechanics._wake()
        story.evidence["kick"] += 1

    story.every(0.008, kick, "right_elbow", since_s=2.4)


@case(
    "movement",
    "x_fast mx_bulk x_sync",
    subject=("head_pitch",),
    cause=r"implaus|jump|encoder|outlier|position|leap",
)
def encoder_has_a_dead_spot(story: Story) -> None:
    """The encoder of a neck has a scratch: at one angle it reads 60 degrees too much now and then."""

    def scratched(show: Callable[[], int]) -> int:
        real = show()
        if story.random.random() > 0.06:
            return real
        story.evidence["leap"] += 1
        return real + 680

    story.shown("head_pitch", "present_position", scratched, 2.0)


@case(
    "movement",
    "mx_two x_fast",
    subject=("right_elbow",),
    cause=SOFT + r"|slow|late|acceler|profile|ramp|speed|limit",
)
def acceleration_tiny(story: Story) -> None:
    """Another program leaves an elbow an acceleration so small that it reaches each turning point late and
    swings beyond it."""
    story.motion = story.swing(0.5, 0.6)
    story.joint("right_elbow")["limits"]["velocity"] = "3 rad/s"
    story.at(
        2.3, lambda: poke(story, "right_elbow", goal_acceleration=6, profile_acceleration=3), "right_elbow"
    )
    lags(story, "right_elbow", 0.08, 2.8)


@case(
    "movement",
    "mx_bulk x_sync",
    subject=("right_knee",),
    cause=OPPOSED + r"|slip|jerk|jump|sudden|twitch|disturb|shak|osc",
)
def foot_slips(story: Story) -> None:
    """The leg carries weight; its foot slips again and again: for some 60 ms the load of the knee is gone,
    then it is back with a blow."""
    slips = [2.45 + 0.37 * number + story.random.uniform(0.0, 0.1) for number in range(7)]
    weight = 1.5 if story.kind.protocol == 1.0 else 0.35

    def load(t_s: float, q: float, dq: float) -> float:
        since = [t_s - at_s for at_s in slips if 0.0 <= t_s - at_s < 0.12]
        story.evidence["slips"] += bool(since)
        if t_s < 0.6 or (since and since[0] < 0.06):
            return 0.0
        return 2.2 * weight if since else weight

    shove(story, "right_knee", load, "loaded")


@case("movement", "ax_single x_three", subject=("left_elbow",), cause=OPPOSED)
def rubber_band(story: Story) -> None:
    """A rubber band is caught at an arm: from 5 degrees of the elbow on it pulls back, the more the further;
    on the other side nothing."""
    most = 1.3 if story.kind.protocol == 1.0 else 1.9
    story.motion = story.swing(0.6, 0.45)

    def pull(t_s: float, q: float, dq: float) -> float:
        return -most * max(0.0, q - 0.09) / 0.5 if t_s > 2.0 else 0.0

    shove(story, "left_elbow", pull, "pulls")
    lags(story, "left_elbow", 0.05, 2.2)


@case(
    "movement",
    "mx_bulk x_fast",
    subject=("right_shoulder",),
    cause=r"backlash|\bplay\b|slack|hystere|dead ?(band|zone)|loose|revers|lost motion|" + SOFT + "|" + STUCK,
)
def play_in_the_gear(story: Story) -> None:
    """The last gear has 6 degrees of play: after each reversal the output, and the encoder on it, stands
    still until the play is through."""
    half = 34
    at: list[int] = []

    def behind(show: Callable[[], int]) -> int:
        now = show()
        at[:] = [min(now + half, max(now - half, at[0] if at else now))]
        story.evidence["behind"] += at[0] != now
        return at[0]

    story.motion = story.swing(0.4, 0.6)
    story.shown("right_shoulder", "present_position", behind, 1.6)


@case("movement", "mx_bulk x_fast", subject=("left_shoulder",), cause=OPPOSED, first=2)
def dry_bearing_on_a_busy_machine(story: Story) -> None:
    """The bearing of a shoulder runs dry: from second to second it takes more torque to turn it. Beside that
    the machine now and then wakes the loop a little late, with no skipped period."""
    story.motion = story.swing(0.5, 0.5)
    stall_nm = 2.5 if story.kind.protocol == 1.0 else 3.8

    def rub(t_s: float) -> None:
        shaft = story.servo("left_shoulder").shaft
        shaft.mechanics.plant._friction[shaft.index] = 0.05 + 0.16 * stall_nm * (t_s - 1.6)
        shaft.mechanics._wake()

    story.every(0.02, rub, "left_shoulder", since_s=1.7)
    story.never_overloads("left_shoulder")
    late_wakes(story, 2.5, 5.0, 0.03, (0.001, 0.003))

    def check(log: Log) -> None:
        times = log.cycles["scheduled_ns"] / S
        off = np.abs(column(log, "goal_position", "left_shoulder") - column(log, "position", "left_shoulder"))
        before = off[(times >= 2.0) & (times < 3.0)].mean()
        story.evidence["rubs"] += off[(times >= 4.0) & (times < 5.0)].mean() > 1.5 * before

    story.checks.append(check)
