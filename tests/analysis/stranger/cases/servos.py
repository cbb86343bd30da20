"""Servos that are worn, hot, exchanged or set wrongly, and joints that something outside holds or presses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from tests.analysis.stranger.expectation import (
    FOLLOWS,
    HEAT,
    LOAD,
    LOST,
    REBOOTS,
    Case,
    collector,
    others,
)
from tests.analysis.stranger.kit import Story
from tests.analysis.stranger.proof import lags, load_changes, seen, start_refused, unread
from tests.analysis.stranger.world import carry, hard_stop, poke, set_before, shove

CASES: list[Case] = []
case = collector(CASES)


# Settings


@case(
    "servo",
    "mx_bulk x_three",
    subject=("right_elbow",),
    cause=FOLLOWS
    + r"|oscillat|swing|vibrat|shak|overshoot|hunt|unstable|instab|resonan|jitter|trembl|rings|ringing",
)
def integral_left_high(story: Story) -> None:
    """A tuning session leaves an integral gain in one servo: it overshoots, and never comes to rest."""
    story.joint("right_elbow")["simulation"] |= {"inertia": "0.03 kg m^2"}
    story.motion = story.swing(right_elbow="0.35 * sin(1.6 * t)")
    set_before(story, "right_elbow", i_gain=250, position_i_gain=16000)
    lags(story, "right_elbow", 0.1, 1.6)


@case("servo", "mx_bulk x_fast", subject=("right_knee",), cause=FOLLOWS + r"|slow|sluggish|gain|damp|crawl")
def moves_as_in_honey(story: Story) -> None:
    """A tuning session left a knee with a huge derivative gain: it is far behind its goals, as in honey."""
    story.motion = story.swing(right_knee="0.6 * sin(2.4 * t)")
    set_before(story, "right_knee", d_gain=254, position_d_gain=16383)
    lags(story, "right_knee", 0.17)


@case(
    "servo",
    "mx_bulk x_fast",
    subject=("head_yaw",),
    cause=r"limit|narrow|angle|range|refus",
    good=False,
)
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


@case("servo", "x_fast x_three", subject=("right_shoulder",), cause=r"shadow|secondary", good=False)
def shadow_of_the_elbow(story: Story) -> None:
    """The Secondary ID of a shoulder is that of the elbow, so it would take its goals: refused."""
    elbow = story.id("right_elbow")
    set_before(story, "right_shoulder", secondary_id=elbow, secondary_shadow_id=elbow)
    start_refused(story)


@case("servo", "mx_two x_three", subject=("left_elbow",), cause=LOST + r"|status return", good=False)
def told_never_to_answer(story: Story) -> None:
    """A stray write sets a servo's Status Return Level to 0: it obeys all goals, and answers nothing."""
    story.at(2.4, lambda: poke(story, "left_elbow", status_return_level=0), "left_elbow")
    unread(story, "left_elbow", 20)


@case(
    "servo",
    "mx_two x_fast",
    subject=("right_elbow",),
    cause=r"torque|already|holds|take.?over|another|stiff|\bon\b",
    good=False,
)
def torque_left_by_a_crash(story: Story) -> None:
    """Yesterday's script crashed and left one servo with torque: the start is refused."""
    set_before(story, "right_elbow", torque_enable=1)
    start_refused(story)


@case(
    "servo", "mx_bulk x_three", subject=("left_knee",), cause=r"model|another|wrong|expect|differ", good=False
)
def knee_of_another_model(story: Story) -> None:
    """A knee was exchanged for a servo of another model, with the same ID: the start is refused."""
    set_before(story, "left_knee", model_number=29 if story.kind.protocol == 1.0 else 1030)
    start_refused(story)


@case("servo", "ax_single x_fast", subject=("head_pitch",), cause=LOST + r"|not found|ID|respond", good=False)
def exchanged_and_never_given_its_id(story: Story) -> None:
    """A new servo in the neck has another ID than the robot file says: under that one no servo answers."""
    set_before(story, "head_pitch", id=77)
    start_refused(story)


# Heat


@case(
    "servo",
    "mx_two x_fast",
    subject=("right_shoulder",),
    cause=HEAT + r"|shut|limp|no torque|lost its torque|overheat",
    good=False,
)
def shuts_down_at_mild_heat(story: Story) -> None:
    """A servo's temperature limit was once set to 47 degrees C: it switches itself off in the warm lab."""
    set_before(story, "right_shoulder", temperature_limit=47)
    story.at(2.6, lambda: story.servo("right_shoulder").set_temperature(49.0), "right_shoulder")
    story.at_end(lambda: story.was_on("right_shoulder", 2.4), "held before")
    story.at_end(lambda: not story.was_on("right_shoulder", 3.6), "limp")


@case("servo", "mx_bulk x_three", subject=("left_knee",), cause=HEAT)
def warms_without_end(story: Story) -> None:
    """The vents of a knee are taped over: it gets warmer and warmer, and does not yet switch off."""
    story.duration_s = 7.0
    story.motion = story.swing()
    warm_up(story, "left_knee", 41.0, 7.0)


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


# Wear


@case(
    "servo",
    "mx_two x_three",
    subject=("left_shoulder",),
    cause=rf"(?=.*({LOAD}))(?=.*(less|fell|fall|drop|gone|vanish|lower|longer|chang|half|disappear|smaller"
    r"|lost|from|without|hardly|no\b))|slip|horn|coupl|loose|unloaded|lighter|carries nothing",
)
def horn_slips(story: Story) -> None:
    """The screws of a horn come off: the servo goes on following its goals, and carries nothing any more."""
    story.joint("left_shoulder")["simulation"] |= {"gravity": "1.1 Nm", "inertia": "0.004 kg m^2"}
    story.motion = story.swing(left_shoulder="0.7 + 0.25 * sin(1.9 * t)")
    story.at(3.2, lambda: carry(story, "left_shoulder", 0.0), "left_shoulder")

    load_changes(story, "left_shoulder", "lighter", 3.2, lambda before, after: after < before / 2)


@case("servo", "mx_bulk x_fast", subject=("left_elbow",), cause=FOLLOWS + r"|slip|gear|tooth|teeth|" + LOAD)
def gear_lacks_teeth(story: Story) -> None:
    """Some teeth of a gear are gone: in one part of the travel nothing holds the forearm, elsewhere all is
    well."""
    story.joint("left_elbow")["simulation"] |= {"gravity": "0.7 Nm"}
    story.motion = story.swing(left_elbow="0.45 + 0.45 * sin(1.9 * t - 1.57)")
    free = False

    def look(t_s: float) -> None:
        nonlocal free
        if free != (0.35 < story.q("left_elbow") < 0.7):
            free = not free
            story.weaken("left_elbow", 0.03 if free else 1 / 0.03)

    story.every(0.004, look, "left_elbow", 1.0)
    lags(story, "left_elbow", 0.12)


@case(
    "servo",
    "ax_single x_three",
    subject=("right_shoulder",),
    cause=r"jump|spike|leap|encoder|potentiometer|sensor|implausib|invalid|nois|erratic|discard|glitch|impossible"
    r"|position.*(wrong|reading|value|sample)|outlier|faster than",
)
def worn_spot_of_the_encoder(story: Story) -> None:
    """A worn spot: in a small part of the travel the position that a servo shows is anywhere; the shaft moves
    evenly."""
    story.motion = story.swing(right_shoulder="0.4 * sin(2.1 * t)")

    def show(before: Callable[[], int]) -> int:
        tick = before()
        if -0.02 < story.q("right_shoulder") < 0.09:
            story.evidence["wrong"] += 1
            return max(0, tick + story.random.choice((-1, 1)) * story.random.randint(90, 300))
        return tick

    story.shown("right_shoulder", "present_position", show, 1.2)


@case("servo", "ax_single x_fast", subject=("head_pitch",), cause=REBOOTS, good=False)
def reboots_again_and_again(story: Story) -> None:
    """A cracked solder joint: a servo starts again every second."""
    for at in ("1600ms", "2700ms", "3800ms", "4600ms"):
        story.fault(f"reboot servo={{id}} at={at} for=140ms", "head_pitch")


@case(
    "two",
    "ax_single x_fast",
    subject=("right_elbow",),
    cause=FOLLOWS + "|" + LOAD,
    innocents=others("right_elbow", "left_knee"),
    first=2,
)
def loose_plug_and_a_weak_servo(story: Story) -> None:
    """A knee's plug is loose, and far from it an elbow is worn and too weak: neither explains the other."""
    story.joint("right_elbow")["simulation"] |= {"gravity": "0.7 Nm"}
    story.motion = story.swing(right_elbow="0.8 + 0.3 * sin(1.6 * t)")
    story.never_overloads("right_elbow")
    story.fault("lossy servo={id} share=0.12 at=1200ms", "left_knee")
    story.at(1.5, lambda: story.weaken("right_elbow", 0.16), "right_elbow")
    lags(story, "right_elbow", 0.12, 1.6)
    unread(story, "left_knee", 5)


# Hands, obstacles and weights


@case(
    "servo",
    "ax_single x_fast",
    subject=("right_elbow",),
    cause=FOLLOWS
    + r"|block|stop|obstacl|collid|stuck|jam|obstruct|hits?\b|overload|(one|same) (side|direction)",
)
def blocked_on_one_side(story: Story) -> None:
    """A cable tie stands in the way of an elbow above an angle; downwards it is free."""
    story.motion = story.swing(right_elbow="0.4 * sin(2.3 * t)")
    hard_stop(story, "right_elbow", 0.12)
    lags(story, "right_elbow", 0.15)


@case(
    "robot",
    "ax_single x_fast",
    subject=("right_elbow",),
    cause=FOLLOWS + r"|held|hand|hold|block|obstruct|stuck|displac|hinder|resist|extern|" + LOAD,
)
def held_by_a_hand(story: Story) -> None:
    """A hand takes hold of the forearm for a second and a half, and lets go."""
    story.motion = story.swing(right_elbow="0.4 * sin(2.0 * t)")

    def hand(t_s: float, q: float, dq: float) -> float:
        return 25.0 * (0.45 - q) - 0.25 * dq if 2.3 < t_s < 3.7 else 0.0

    shove(story, "right_elbow", hand, "held")
    story.never_overloads("right_elbow")
    lags(story, "right_elbow", 0.25)


@case("robot", "mx_two x_three", subject=("right_shoulder",), cause=FOLLOWS + "|" + LOAD)
def lifts_what_is_too_heavy(story: Story) -> None:
    """A gripper takes a dumbbell: from then on the raised arm is too heavy for its shoulder."""
    story.motion = story.swing(right_shoulder="0.8 + 0.3 * sin(1.6 * t)")
    heavy = 2.4 if story.kind.protocol == 1.0 else 3.6
    story.at(2.5, lambda: carry(story, "right_shoulder", heavy), "right_shoulder")
    lags(story, "right_shoulder", 0.15, 2.5)


@case(
    "robot",
    "ax_single x_three",
    subject=("left_shoulder",),
    cause=FOLLOWS + r"|weight|gravity|rest|still|hold|" + LOAD,
)
def arm_leans_on_the_table(story: Story) -> None:
    """At rest an arm leans on the edge of the table with its forearm: its shoulder presses for seconds
    against what does not give way."""
    story.play()
    pose = {"points": [{"time": 1.5, "positions": [0.0, 0.0, 0.6, *[0.0] * 5]}]}
    story.asks.append((0.8, "body", "trajectory", pose))
    story.never_overloads("left_shoulder")
    hard_stop(story, "left_shoulder", 0.42)
    lags(story, "left_shoulder", 0.12, 3.0)


@case(
    "robot",
    "mx_bulk x_fast",
    subject=("left_shoulder",),
    cause=FOLLOWS + r"|limp|extern|" + LOAD,
    innocents=others("left_shoulder", "left_elbow"),
)
def lies_on_its_arm(story: Story) -> None:
    """The robot lies on its left arm: shoulder and elbow are pressed with nearly all that they can bear."""

    def press(share: float) -> Callable[[float, float, float], float]:
        most = (1.9 if story.kind.protocol == 1.0 else 2.9) * share
        return lambda t_s, q, dq: -most - 0.02 * dq if t_s > 2.5 else 0.0

    shove(story, "left_shoulder", press(1.0), "pressed")
    shove(story, "left_elbow", press(0.5), "pressed too")
    lags(story, "left_shoulder", 0.08, 2.5)
