"""What a robot is told to do: its programs, sensors and devices, and what only looks odd."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from tests.analysis.stranger.expectation import BUSES, HARDWARE, TURNS, Case, collector, others, together
from tests.analysis.stranger.kit import ARMS, HEAD, JOINTS, LEFT, RIGHT, Broken, S, Story, stronger
from tests.analysis.stranger.proof import goals_move, goals_stand, lags, said, seen, spread, turns
from tests.analysis.stranger.world import foot_board, imu_reads, noisy_imu, read_slowly, stream_to_arms

from dxlrun.log.reader import Log

CASES: list[Case] = []
case = collector(CASES)


# Programs


@case(
    "program",
    "ax_single x_fast",
    cause=r"\bstream|\blease|set-?points?|client|teleop|stale|no (new )?(commands?|goals?)|stopped sending"
    r"|without (a )?command|commands? .*(stop|late|miss|gap|end)|ran out|run out|runs out",
    innocents=(*JOINTS, "hardware"),
)
def stream_runs_out(story: Story) -> None:
    """The program that streams goals to the arms dies in the middle of a movement; its lease of 0.2 s runs
    out, and the arms stand still for the rest of the run, while head and legs go on."""
    story.clients = ("teleop",)
    stream_to_arms(
        story,
        200,
        (
            (t_s, [(0.3 + 0.1 * place) * math.sin(2.2 * (t_s - 0.6)) for place in range(len(ARMS))])
            for t_s in np.arange(0.6, 3.1, 0.03).tolist()
        ),
    )
    said(story, "stream")


@case(
    "program",
    "ax_single x_three",
    cause=TURNS,
    innocents=(*JOINTS, "hardware"),
)
def head_goes_from_hand_to_hand(story: Story) -> None:
    """A tracker that sees the ball and a search that does not see it take the head from each other, four
    times a second from the second second on, each with a goal of its own: the head is torn to and fro."""
    controllers = story.spec["controllers"]
    controllers["body"]["joints"] = [*LEFT, *RIGHT]
    controllers["track"] = {"type": "joint_group_position_controller", "joints": list(HEAD)}
    controllers["search"] = {
        "type": "joint_group_position_controller",
        "joints": list(HEAD),
        "active": False,
    }
    story.motion = story.swing()
    story.clients = ("behaviour",)
    for number in range(17):
        on, off = ("search", "track") if number % 2 == 0 else ("track", "search")
        at_s = 1.2 + 0.25 * number
        story.asks.append((at_s, "", "switch", {"activate": [on], "deactivate": [off]}))
        goals = {"positions": [0.35, 0.1] if on == "search" else [-0.25, -0.1]}
        story.asks.append((at_s + 0.05, on, "positions", goals))
    said(story, "search", 6)
    seen(story, "goal_position", "head_yaw", lambda values: turns(values) > 8)


@case(
    "robot",
    "mx_bulk x_fast",
    cause=together(("body", "stand"), r"rais|fail|fault|exception|\w+Error|fallback|ended"),
    innocents=(*JOINTS, "hardware"),
    good=False,
)
def fallback_fails_too(story: Story) -> None:
    """The walking controller raises; the fallback that takes over has the same mistake, and raises half a
    second later: nothing is left to command the robot."""
    controllers = story.spec["controllers"]
    controllers["body"]["fallback"] = "stand"
    controllers["stand"] = {
        "type": "joint_group_position_controller",
        "joints": list(JOINTS),
        "active": False,
    }

    def fail(controller: Broken) -> None:
        raise KeyError("left_foot")

    story.break_controller("body", 2.3, fail)
    story.break_controller("stand", 2.8, fail)


@case(
    "program",
    "mx_two x_fast",
    subject=("body",),
    cause=r"\bnan\b|not a number|finite|not valid|invalid|no number",
    good=False,
    innocents=(*others("right_elbow"), *BUSES, "hardware"),
)
def nan_once(story: Story) -> None:
    """A controller's square root gets a negative number once, for one elbow: its goal there is NaN in that
    one cycle; all others were sound."""
    row = JOINTS.index("right_elbow")
    given = [0]

    def root(controller: Broken) -> None:
        if not given[0]:
            given[0] += 1
            controller.context.commands.position[row] = math.nan
            story.evidence["nan"] += 1

    story.break_controller("body", 2.9, root)


# Sensors and devices


@case(
    "sensor",
    "mx_bulk x_fast",
    cause=r"(imu|gyro|sensor|orientation|acceler)"
    r".*(\bold|\bage|aged|stale|no new|not new|newer|late|froz|stuck|hang|hung|same|stopp"
    r"|silent|ms|s old|outdated|dead)"
    r"|(\bold|stale|froz|stuck|no new).*(imu|gyro|sensor|orientation|acceler)",
    innocents=JOINTS,
)
def imu_grows_old(story: Story) -> None:
    """The thread that reads the IMU hangs in its driver: from then on the last sample is given again and
    again, with the time at which it was taken; it gets older and older while the torso swings."""
    story.upright("right_knee")
    story.checks.clear()  # it does not fall
    noisy_imu(story)
    story.motion = story.swing(right_knee="0.35 * sin(2.1 * t)")

    last: list[Any] = []

    def hung(read: Callable[[Any], int], values: Any) -> int:
        if story.now_s() < 2.5 or not last:
            last[:] = [read(values), values.copy()]
        else:
            values[:] = last[1]
            story.evidence["old"] += 1
        return int(last[0])

    imu_reads(story, hung)


@case(
    "device",
    "mx_bulk x_fast",
    subject=("foot",),
    cause=r"jump|spike|leap|outlier|implaus|erratic|glitch|nois|sudden|wild|flicker"
    r"|saturat|out of range|changes"
    r"|contact|times (its|the)",
    innocents=JOINTS,
)
def foot_board_spikes(story: Story) -> None:
    """The ribbon cable of a force cell in the foot has a bad crimp: of one of four cells every tenth
    reading or so is three or four times too much, the others tremble by some steps as ever."""
    foot_board(story)

    def crimp() -> None:
        registers = story.bus(0).device(101).registers
        live = dict(registers._live)
        name = next(name for name in live if name in registers and live[name]() > 100)
        sound = live[name]

        def spiked() -> int:
            if story.random.random() > 0.1:
                return sound()
            story.evidence["spike"] += 1
            # the cells are a float32 on Protocol 2.0, whose exponent begins at bit 23
            return min(3 * sound(), 65_000) if story.kind.protocol == 1.0 else sound() + (2 << 23)

        registers.show_live({**live, name: spiked})

    story.at(1.8, crimp)

    def check(log: Log) -> None:
        states = log.cycles["source_state"][log.cycles["scheduled_ns"] > 2 * S]
        story.evidence["spikes"] += int((states > 2.0 * np.median(states, axis=0)).sum()) > 10

    story.checks.append(check)


# What only looks odd


@case("fine", "mx_bulk x_fast", good=True, innocents=HARDWARE)
def heavy_squats(story: Story) -> None:
    """The robot does squats with its own weight on both knees: a third of what they can give, at a slow pace,
    and they follow as a P control does."""
    load = "2 Nm" if story.kind.protocol == 1.0 else "3.5 Nm"
    for name in ("left_knee", "right_knee"):
        story.joint(name)["simulation"].update(gravity=load, inertia="0.02 kg m^2")
    squat = "0.4 - 0.4 * cos(1.4 * t)"
    story.motion = story.swing(0.15, left_knee=squat, right_knee=squat)
    seen(story, "effort", "left_knee", lambda values: np.nanmax(np.abs(values)) > 0)


@case("fine", "ax_single x_three", innocents=HARDWARE)
def halted_at_the_end(story: Story) -> None:
    """The experimenter has seen enough and halts the robot in the middle of a motion; it holds its pose until
    the end of the run."""
    story.asks.append((3.2, "", "halt", {}))
    goals_stand(story, 3.8)


@case("fine", "mx_bulk x_fast", good=True, innocents=HARDWARE)
def slow_model_in_the_neck(story: Story) -> None:
    """The neck has a slower and stronger model than the other joints, and is moved as fast as it can follow:
    it lags more than its peers, as it always did."""
    slow = "MX-106" if story.kind.protocol == 1.0 else "XH430-W350"
    story.joint("head_yaw")["model"] = slow
    story.motion = story.swing(head_yaw="0.6 * sin(3.2 * t)")
    seen(story, "velocity", "head_yaw", lambda values: np.nanmax(np.abs(values)) > 1.2)


@case("fine", "mx_two x_fast", good=True, innocents=HARDWARE)
def switched_once_to_look(story: Story) -> None:
    """A client hands the head over from the motion's controller to one that looks at a ball, once; the new
    one gets its goals, a few degrees each."""
    controllers = story.spec["controllers"]
    controllers["body"]["joints"] = [*LEFT, *RIGHT]
    controllers["nod"] = {"type": "joint_trajectory_controller", "joints": list(HEAD)}
    controllers["look"] = {"type": "joint_group_position_controller", "joints": list(HEAD), "active": False}
    story.play(*story.swing()["motions"])
    story.asks.append((0.8, "nod", "trajectory", {"points": [{"time": 1.2, "positions": [0.1, 0.05]}]}))
    story.asks.append((2.4, "", "switch", {"activate": ["look"], "deactivate": ["nod"]}))
    for number in range(20):
        goals = [0.1 + 0.01 * number, 0.05 - 0.005 * number]
        story.asks.append((2.7 + 0.1 * number, "look", "positions", {"positions": goals}))
    goals_move(story, 2.8)


@case("fine", "mx_bulk x_fast", good=True, innocents=HARDWARE)
def right_arm_with_a_drill(story: Story) -> None:
    """By design the right arm carries a drill: its shoulder and elbow bear three times the load of the left
    ones and lag a little more, from the beginning to the end."""
    for joint, old, new in (
        ("left_shoulder", 0.25, 0.5),
        ("left_elbow", 0.12, 0.25),
        ("right_shoulder", 0.75, 1.5),
        ("right_elbow", 0.36, 0.75),
    ):
        story.joint(joint)["simulation"].update(
            gravity=f"{stronger(story, old, new)} Nm", inertia="0.006 kg m^2"
        )
    alike = "0.4 + 0.25 * sin(1.9 * t)"
    story.motion = story.swing(**dict.fromkeys(ARMS, alike))
    story.evidence["drill"] += 1


@case("fine", "mx_two x_three", innocents=HARDWARE)
def rate_lowered_for_good(story: Story) -> None:
    """A client lowers the loop's rate to three fifths in the run, as the robot is to save power, and leaves
    it there."""
    rate = story.kind.rate
    story.asks.append((2.2, "", "rate", {"rate": round(0.6 * rate)}))
    story.checks.append(lambda log: story.evidence.update(slower=int(len(log.cycles) < 5.2 * rate)))


@case("fine", "mx_bulk x_fast", innocents=HARDWARE)
def planned_torque_off(story: Story) -> None:
    """The head is let go as planned, by a client that has deactivated its controller before; a hand turns it
    aside while it is limp. The rest of the robot plays its motion."""
    controllers = story.spec["controllers"]
    controllers["body"]["joints"] = [*LEFT, *RIGHT]
    controllers["look"] = {"type": "joint_group_position_controller", "joints": list(HEAD)}
    story.motion = story.swing()
    story.asks.append((2.0, "", "switch", {"activate": [], "deactivate": ["look"]}))
    story.asks.append((2.3, "", "torque", {"joints": list(HEAD), "on": False}))
    story.fault("turn servo={id} by=22deg for=900ms at=3s", "head_yaw")
    story.at_end(lambda: not story.was_on("head_yaw", 2.9), "limp as planned")
    story.at_end(lambda: abs(story.q("head_yaw")) > 0.3, "turned")


@case("fine", "ax_single x_three", good=True, innocents=HARDWARE)
def limp_wrist_dangles(story: Story) -> None:
    """An elbow is limp by the robot file, as a pendulum: a hand lifts it by some 30 degrees and lets go,
    twice, and it swings back under its weight."""
    story.joint("left_elbow")["torque"] = "off"
    story.spec["controllers"]["body"]["joints"].remove("left_elbow")
    story.joint("left_elbow")["simulation"].update(gravity=f"{stronger(story, 0.4, 1.0)} Nm")
    story.motion = story.swing()
    story.fault("turn servo={id} by=30deg for=500ms at=1500ms", "left_elbow")
    story.fault("turn servo={id} by=-35deg for=500ms at=3500ms", "left_elbow")
    seen(story, "position", "left_elbow", lambda values: spread(values) > 0.3)


@case("fine", "mx_two x_fast", good=True, innocents=HARDWARE)
def rough_stream_that_works(story: Story) -> None:
    """A client streams goals to the arms by a bad wireless link: they come at uneven times, 15 to 90 ms
    apart, with a noise of tenths of a degree, but never so late that the lease of 0.3 s runs out."""
    story.clients = ("teleop",)

    def goals() -> Iterator[tuple[float, list[float]]]:
        t_s = 0.6
        while t_s < 5.95:
            swing = math.sin(1.3 * (t_s - 0.6))
            yield (
                t_s,
                [(0.25 + 0.05 * at) * swing + story.random.gauss(0.0, 0.004) for at in range(len(ARMS))],
            )
            t_s += story.random.uniform(0.015, 0.09)

    stream_to_arms(story, 300, goals())
    goals_move(story, 4.0)


@case("fine", "ax_single x_fast", good=True, innocents=HARDWARE)
def steps_and_rests(story: Story) -> None:
    """A calibration: each second all joints step at once to a pose some 12 degrees away, and rest there;
    for a moment after each step they are far from their goals, as they must be."""
    story.spec["controllers"]["body"]["type"] = "joint_group_position_controller"
    story.play()
    for number in range(5):
        sign = 1 if number % 2 == 0 else -1
        goals = [0.1 * sign * (1 if place % 2 else -1) for place in range(len(JOINTS))]
        story.asks.append((1.0 + number, "body", "positions", {"positions": goals}))
    lags(story, "left_knee", 0.08, 1.5)


@case("fine", "mx_bulk x_three", good=True, innocents=HARDWARE)
def warms_up_as_all_do(story: Story) -> None:
    """A cold robot is switched on and warms up as it works: all servos go from 24 to 36 degrees C, the
    knees to 41, far from any limit."""
    read_slowly(story)

    def warm(t_s: float) -> None:
        for name in JOINTS:
            most = 17.0 if "knee" in name else 12.0
            story.servo(name).temperature = 24.0 + most * min(1.0, t_s / 5.5)
        story.evidence["warm"] += 1

    story.every(0.1, warm, 0)
    seen(story, "temperature", "left_knee", lambda values: np.nanmax(values) > 38)


@case("fine", "mx_two x_fast", innocents=HARDWARE)
def called_off_and_sent_elsewhere(story: Story) -> None:
    """A client calls its own goal off half-way, lets the robot stand for a second, and sends it to another
    pose, where it arrives."""
    story.play()
    far = {"points": [{"time": 3.0, "positions": [0.45] * 8}]}
    back = {"points": [{"time": 1.2, "positions": [-0.1] * 8}]}
    story.asks.append((0.9, "body", "trajectory", far))
    story.asks.append((2.2, "", "cancel", {"controller": "body"}))
    story.asks.append((3.3, "body", "trajectory", back))
    goals_move(story, 3.3)
    story.at_end(lambda: abs(story.q("left_knee") + 0.1) < 0.08, "arrived")
