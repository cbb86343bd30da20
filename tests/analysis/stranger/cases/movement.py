"""Joints, servos and their settings that fail."""

from __future__ import annotations

import numpy as np
from tests.analysis.stranger.expectation import (
    FOLLOWS,
    HEAT,
    LATE,
    LOAD,
    REBOOTS,
    SOFT,
    STUCK,
    Case,
    collector,
)
from tests.analysis.stranger.kit import Story, freeze
from tests.analysis.stranger.proof import lags, seen, start_refused
from tests.analysis.stranger.world import set_before, voltages_often

CASES: list[Case] = []
case = collector(CASES)


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
        servo.advance_to(story.bus("left_knee").now_ns)
        servo.voltage = max(10.2, 12.0 - 7.0 * abs(servo.shaft.duty * servo.shaft.current))
        story.evidence["sagged"] += servo.voltage < 10.8
        servo.apply_protection()

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
        servo.shaft.mechanics.move_shaft(servo.shaft.index, servo.shaft_angle + 0.35)
        story.evidence["slip"] += 1

    story.every(0.6, slip, "right_elbow", since_s=2.3)


@case("movement", "x_fast mx_two ax_single", subject=("right_knee",), cause=STUCK + r"|behind|limited")
def blocked_without_load(story: Story) -> None:
    """A knee is blocked by a cable tie, while its servo gives next to no torque, as its limit is low."""
    item = ("goal_pwm", 60) if story.kind.protocol == 2 else ("torque_limit", 70)
    story.at(1.0, lambda: story.servo("right_knee").poke(*item), "right_knee")
    story.never_overloads("right_knee")
    story.fault("jam servo={id} at=2400ms", "right_knee")


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


@case("movement", "ax_single x_three", subject=("left_elbow",), cause=STUCK)
def runs_into_a_wall(story: Story) -> None:
    """An elbow runs into a table and pushes for two seconds, then is free again."""
    story.fault("jam servo={id} at=2300ms for=900ms", "left_elbow")


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


@case("servo", "mx_bulk x_fast", subject=("head_yaw",), cause=r"limit|narrow|angle|range|refus", good=False)
def limits_left_narrow(story: Story) -> None:
    """The angle limits in one servo's own memory are narrower than those of the robot file, as another robot
    needed them: the start is refused."""
    set_before(story, "head_yaw", cw_angle_limit=1850, ccw_angle_limit=2246)
    set_before(story, "head_yaw", min_position_limit=1850, max_position_limit=2246)
    start_refused(story)


@case("servo", "ax_single x_fast", subject=("left_shoulder",), cause=FOLLOWS + r"|limit|PWM|" + LOAD)
def output_left_at_a_tenth(story: Story) -> None:
    """A tool leaves a servo with a tenth of its output: it is too weak for its arm."""
    story.joint("left_shoulder")["simulation"] |= {"gravity": "0.7 Nm"}
    story.motion = story.swing(left_shoulder="0.75 + 0.3 * sin(1.7 * t)")
    story.never_overloads("left_shoulder")
    set_before(story, "left_shoulder", max_torque=110, torque_limit=110, pwm_limit=90, goal_pwm=90)
    lags(story, "left_shoulder", 0.12, 1.6)


@case("two", "mx_two x_three", subject=("right_elbow",), cause=HEAT, first=2)
def hot_elbow_and_a_slow_machine(story: Story) -> None:
    """An elbow gets near its limit of temperature, while the machine is busy and late now and then."""
    story.duration_s = 7.0
    story.motion = story.swing()
    story.stall(lambda number: 0.022 if number % 37 == 5 else 0.0, 1.0)
    warm_up(story, "right_elbow", 45.0, 8.0)


def warm_up(story: Story, joint: str, from_c: float, per_s: float) -> None:
    """Let a servo get warmer (degrees C, and those per second), to just below its limit."""

    def heat(t_s: float) -> None:
        story.servo(joint).temperature = min(77.0, from_c + per_s * (t_s - 0.5))
        story.evidence["heated"] += 1

    story.every(0.1, heat, joint, 0.5)
    seen(story, "temperature", joint, lambda values: np.nanmax(values) > 72)


@case("servo", "ax_single x_fast", subject=("head_pitch",), cause=REBOOTS, good=False)
def reboots_again_and_again(story: Story) -> None:
    """A cracked solder joint: a servo starts again every second."""
    for at in ("1600ms", "2700ms", "3800ms", "4600ms"):
        story.fault(f"reboot servo={{id}} at={at} for=140ms", "head_pitch")
