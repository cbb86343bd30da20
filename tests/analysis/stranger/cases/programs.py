"""Controllers, clients, IMUs and machines that fail or are used wrongly, and runs that only look odd."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from tests.analysis.stranger.expectation import BUSES, FOLLOWS, HARDWARE, Case, collector, others, together
from tests.analysis.stranger.kit import HEAD, JOINTS, LEFT, RIGHT, Broken, Story
from tests.analysis.stranger.proof import goals_move, goals_stand, lags, said, seen, spread
from tests.analysis.stranger.world import imu_gives, noisy_imu, supply

CASES: list[Case] = []
case = collector(CASES)


# Controllers and motions


@case(
    "program",
    "ax_single x_three",
    subject=("body",),
    cause=r"\bnan\b|not a number|finite|not valid|invalid|no number|division",
    good=False,
    innocents=(*others("left_elbow"), *BUSES, "hardware"),
)
def nan_where_a_joint_is_straight(story: Story) -> None:
    """A controller divides by the sine of an elbow: where that is straight, its goal is NaN."""
    story.motion = story.swing(left_elbow="0.3 * sin(1.9 * t)")
    row = JOINTS.index("left_elbow")

    def divide(controller: Broken) -> None:
        if abs(controller.context.commands.position[row]) < 0.012:
            controller.context.commands.position[row] = math.nan
            story.evidence["nan"] += 1

    story.evidence["nan"] += 0
    story.break_controller("body", 1.5, divide)


@case(
    "program",
    "mx_two x_three",
    subject=("body",),
    cause=r"limit|clamp|beyond|range|outside|gate|cut off",
    innocents=(*others("left_elbow"), *BUSES, "hardware"),
)
def goals_beyond_the_limit(story: Story) -> None:
    """A controller has radians and degrees mixed up for one joint: its goals lie far beyond the limits, and
    are cut off there."""
    row = JOINTS.index("left_elbow")

    def mix_up(controller: Broken) -> None:
        controller.context.commands.position[row] *= 57.3

    story.break_controller("body", 2.0, mix_up)
    seen(story, "clamped", "left_elbow", lambda values: (values > 0).any())


@case(
    "program",
    "ax_single x_fast",
    subject=("head_pitch",),
    cause=r"oscillat|vibrat|shak|jitter|trembl|nois|swing|alternat|back and forth|fast|Hz|goal|command|step|"
    + FOLLOWS,
    innocents=(*others("head_pitch"), *BUSES, "hardware"),
)
def goals_tremble(story: Story) -> None:
    """A vision program feeds its noise into the goals of a joint: they tremble by degrees from cycle to
    cycle, and the servo with them. The servo is well."""
    row = JOINTS.index("head_pitch")

    def tremble(controller: Broken) -> None:
        controller.context.commands.position[row] += story.random.uniform(-0.07, 0.07)

    story.break_controller("body", 1.5, tremble)


@case(
    "program",
    "mx_bulk x_fast",
    subject=("body",),
    cause=r"slow|took|takes|longer|too long|overrun|budget|comput|updates? .*(ms|s)\b|grow",
    innocents=HARDWARE,
)
def update_grows_longer(story: Story) -> None:
    """A controller keeps a list that grows: each update takes a little longer than the one before, until no
    period is enough."""
    story.slow_controller("body", 1.0, lambda number: min(0.024, number * 6e-5))


@case(
    "program",
    "ax_single x_three",
    subject=("right_shoulder",),
    cause=FOLLOWS + r"|fast|speed|veloc|demand|beyond|keep up|limit",
    innocents=(*others("right_shoulder"), *BUSES, "hardware"),
)
def motion_is_too_fast(story: Story) -> None:
    """A motion asks of one joint what no such servo can do: it swings at its top speed, and lags far behind.
    Nothing is broken."""
    story.joint("right_shoulder")["simulation"] |= {"inertia": "0.01 kg m^2"}
    story.motion = story.swing(right_shoulder=f"0.7 * sin({7.5 if story.kind.protocol == 1.0 else 8.5} * t)")
    lags(story, "right_shoulder", 0.3)


# Clients


@case(
    "program",
    "mx_two x_fast",
    cause=together(
        ("head", "looker", "teleop"),
        r"jump|step|alternat|two|both|client|command|forth|revers|oscillat|fight|turns|sudden|to and fro"
        r"|looker|teleop",
    ),
    innocents=(*LEFT, *RIGHT, *BUSES, "hardware"),
)
def two_clients_at_one_head(story: Story) -> None:
    """Two programs stream goals to one controller, each its own: the head is torn to and fro."""
    story.spec["controllers"]["body"]["joints"] = [*LEFT, *RIGHT]
    story.spec["controllers"]["head"] = {"type": "joint_group_position_controller", "joints": list(HEAD)}
    story.motion = story.swing()
    story.clients = ("teleop", "looker")
    for number in range(40):
        sign = 1 if number % 2 else -1
        goals = {"positions": [0.3 * sign, 0.15 * sign]}
        story.asks.append((1.5 + 0.06 * number, "head", "positions", goals))
    seen(story, "goal_position", "head_yaw", lambda values: (np.abs(np.diff(values)) > 0.02).sum() > 20)


@case(
    "client",
    "ax_single x_three",
    subject=("left_knee",),
    cause=r"torque|limp|\boff\b|releas|switch|client",
)
def wrong_knee_made_limp(story: Story) -> None:
    """A client switches off the torque of the wrong knee in the middle of a motion."""
    story.asks.append((2.5, "", "torque", {"joints": ["left_knee"], "on": False, "release": True}))
    story.at_end(lambda: not story.was_on("left_knee", 3.5), "off")


@case(
    "client",
    "mx_bulk x_fast",
    cause=r"speed|parameter|slow|paus|stopp|stood still|stands? still|client|never|not (reach|end|finish)"
    r"|unfinished|abort|cut|interrupt|incomplete|ended before",
    innocents=HARDWARE,
)
def speed_set_to_zero(story: Story) -> None:
    """A client sets a controller's speed to 0 and leaves it there: the motion stands still for good."""
    story.asks.append((2.2, "", "parameters", {"controller": "body", "values": {"speed": 0}}))
    goals_stand(story, 3.0)


@case(
    "client",
    "ax_single x_fast",
    cause=r"refus|reject|inactive|not active|deactivat|switch|abort|not accept|not taken",
    innocents=HARDWARE,
)
def asks_a_controller_that_is_off(story: Story) -> None:
    """One client deactivates the controller of the body, another one goes on sending it goals."""
    story.asks.append((2.0, "", "switch", {"activate": [], "deactivate": ["body"]}))
    pose = {"points": [{"time": 1.0, "positions": [0.2] * 8}]}
    story.asks += [(2.6 + 0.3 * number, "body", "trajectory", pose) for number in range(6)]
    goals_stand(story, 3.0)


@case(
    "client",
    "mx_two x_fast",
    cause=r"toleran|abort|gave up|given up|too far|miss|path|cancel",
    innocents=(*BUSES, "hardware"),
)
def path_tolerance_too_tight(story: Story) -> None:
    """The tolerance of a path is a third of a degree: the motion is aborted as it begins, though all servos
    follow as they always do."""
    story.spec["controllers"]["body"]["tolerances"] = {"path": "0.3 deg", "goal": "4 deg"}
    said(story, "abort")


# IMUs, and the machine


@case(
    "sensor",
    "mx_bulk x_fast",
    cause=r"(imu|gyro|sensor|acceler|orientation)"
    r".*(froz|freez|same|stuck|unchang|chang|constant|hang|old|stale|stood)"
    r"|(froz|stuck|same|unchang|constant).*(imu|gyro|sensor|acceler|orientation)",
    innocents=JOINTS,
)
def imu_hangs(story: Story) -> None:
    """The IMU's chip hangs: its driver goes on sending samples in time, and all of them are the same, while
    the torso swings."""
    story.upright("right_knee")
    story.checks.clear()  # it does not fall
    noisy_imu(story)
    story.motion = story.swing(right_knee="0.4 * sin(2.2 * t)")
    last: list[Any] = []

    def hang(t_s: float, values: Any) -> None:
        if t_s > 2.2:
            if not last:
                last.append(values.copy())
            values[:] = last[0]
            story.evidence["hangs"] += 1

    imu_gives(story, hang)


@case(
    "sensor",
    "mx_two x_fast",
    cause=r"\bfall|fell|reflex|takes? over|took over|curl|imu|gyro|orientation|tilt|tip",
    innocents=(*BUSES, "hardware"),
)
def imu_board_comes_off(story: Story) -> None:
    """The IMU comes off its mount and dangles: the robot stands, and the reflex takes it for falling."""
    story.upright("right_knee")
    noisy_imu(story)
    story.motion = story.swing(right_knee="0.1 * sin(1.2 * t)")

    def dangle(t_s: float, values: Any) -> None:
        if t_s > 2.5:
            angle = min(1.4, 5.0 * (t_s - 2.5))
            values[0] += 5.0 if angle < 1.4 else 0.0
            y, z = float(values[4]), float(values[5])
            values[4] = math.cos(angle) * y + math.sin(angle) * z
            values[5] = math.cos(angle) * z - math.sin(angle) * y
            story.evidence["dangles"] += 1

    imu_gives(story, dangle)


@case(
    "sensor",
    "ax_single x_fast",
    cause=r"(imu|gyro|sensor|orientation|acceler)",
    innocents=JOINTS,
    good=False,
)
def imu_gone(story: Story) -> None:
    """The cable of the IMU slips out: its driver raises an error each time, and opens it in vain."""
    story.upright("right_knee")
    story.checks.clear()  # it does not fall

    def gone(t_s: float, values: Any) -> None:
        if t_s > 2.6:
            story.evidence["gone"] += 1
            raise OSError(5, "Input/output error")

    imu_gives(story, gone)


@case(
    "host",
    "mx_bulk x_three",
    cause=r"machine|suspend|sleep|stall|stood still|paus|late|skipp|gap|woke|deadline|host|computer|watchdog"
    r"|CPU|busy|scheduler|overslept|did not run",
    innocents=HARDWARE,
    good=False,
)
def machine_sleeps(story: Story) -> None:
    """The lid of the notebook is closed for a moment: the machine sleeps for 2.4 s amid a motion."""
    story.duration_s = 8.0
    story.motion = story.swing()
    story.stall(lambda number: 2.4 if number == 0 else 0.0, 3.0)


# What only looks odd


@case("fine", "mx_two x_three", good=True, innocents=HARDWARE)
def only_the_head_looks_around(story: Story) -> None:
    """The head looks around; all else stands like a statue, as it should."""
    story.motion = story.swing(**dict.fromkeys((*LEFT, *RIGHT), "0"))
    seen(story, "goal_position", "head_yaw", lambda values: spread(values) > 0.2)
    seen(story, "goal_position", "left_knee", lambda values: spread(values) < 0.01)


@case("fine", "ax_single x_three", good=True, innocents=HARDWARE)
def rests_all_the_time(story: Story) -> None:
    """The robot is switched on and asked for nothing at all: every joint holds still."""
    story.play()
    goals_stand(story, 0.0)


@case("fine", "mx_two x_fast", good=True, innocents=HARDWARE)
def arm_led_by_a_hand(story: Story) -> None:
    """A left arm that is limp by the robot file is led by a hand, as one teaches a motion."""
    for joint in LEFT:
        story.joint(joint)["torque"] = "off"
    story.spec["controllers"]["body"]["joints"] = [*RIGHT, *HEAD]
    story.motion = story.swing()
    for number, joint in enumerate(LEFT):
        story.fault(f"turn servo={{id}} by={18 + 9 * number}deg for=1500ms at={1200 + 300 * number}ms", joint)
    seen(story, "position", "left_elbow", lambda values: spread(values) > 0.3)


@case("fine", "mx_bulk x_fast", good=True, innocents=HARDWARE)
def one_reply_in_a_run_is_lost(story: Story) -> None:
    """Of thousands of replies one is lost, and the next one comes: that happens on the best of lines."""
    story.fault("lose servo={id} at=2600ms", "right_elbow")


@case("fine", "mx_bulk x_three", good=True, innocents=HARDWARE)
def warm_lab(story: Story) -> None:
    """A summer's day: all servos have 44 degrees C, as warm as each other, and stay so."""

    def warm(t_s: float) -> None:
        for bus in story.virtual.buses:
            for servo in bus.servos:
                servo.temperature = 44.0

    story.every(0.05, warm, 0)
    seen(story, "temperature", "left_knee", lambda values: np.nanmax(values) > 43)


@case("fine", "mx_bulk x_fast", good=True, innocents=HARDWARE)
def three_cells(story: Story) -> None:
    """The robot runs on a battery of three cells: 11.1 V from the beginning to the end."""

    def before_the_start() -> None:
        for servo in story.bus(0).servos:
            servo.voltage = 11.1

    story.prepared.append(before_the_start)
    supply(story, 0, lambda t_s, servo: 11.1, "three cells")
    seen(story, "voltage", "left_knee", lambda values: np.nanmax(values) < 11.3)


@case("fine", "ax_single x_fast", good=True, innocents=HARDWARE)
def changes_its_mind(story: Story) -> None:
    """A client sends the robot elsewhere four times, each time before it has arrived."""
    story.play()
    for number in range(5):
        pose = {"points": [{"time": 1.6, "positions": [0.3 * (-1) ** number] * 8}]}
        story.asks.append((0.9 + 0.8 * number, "body", "trajectory", pose))
    goals_move(story, 3.0)


@case("fine", "ax_single x_three", good=True, innocents=HARDWARE)
def moves_less_than_a_tick(story: Story) -> None:
    """A breathing motion of hundredths of a degree: the goals change, the positions cannot."""
    story.motion = story.swing(**dict.fromkeys(JOINTS, "0.0006 * sin(1.3 * t)"))
    seen(story, "goal_position", "left_knee", lambda values: 0 < spread(values) < 0.02)


@case("fine", "mx_two x_fast", good=True, innocents=HARDWARE)
def stopped_by_halt_and_sent_on(story: Story) -> None:
    """A client halts the robot in the middle of a motion, then activates its controller again and sends it
    home."""
    story.asks.append((2.0, "", "halt", {}))
    story.asks.append((3.0, "", "switch", {"activate": ["body"], "deactivate": []}))
    story.asks.append((3.5, "body", "trajectory", {"points": [{"time": 1.5, "positions": [0.0] * 8}]}))
    goals_move(story, 3.2)
