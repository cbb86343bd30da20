"""What robots did: their goals, falls, takeovers, and joints that were lost or limp."""

from __future__ import annotations

import math

import numpy as np
from tests.analysis.stranger.expectation import SOFT, Case, collector, others
from tests.analysis.stranger.kit import ARMS, JOINTS, Broken, Story
from tests.analysis.stranger.proof import column, said
from tests.analysis.stranger.world import read_slowly, stream_to_arms

from dxlrun.log.reader import Log

CASES: list[Case] = []
case = collector(CASES)


@case("robot", "mx_bulk x_fast", cause=r"(swing|motion|body|trajector).*\d deg", good=True, first=0)
def motion_played(story: Story) -> None:
    """Nothing happens but a motion that all joints follow: the first line has the motion and the worst
    joint."""
    story.evidence["played"] += 1


@case(
    "robot",
    "mx_bulk x_fast",
    subject=("right_knee",),
    cause=r"overload|limp|no torque|lost its torque|shut",
    good=False,
)
def knee_overloads(story: Story) -> None:
    """A knee trips its overload protection in a motion and is limp from then on."""
    story.fault("overload servo={id} at=2800ms", "right_knee")


@case(
    "robot",
    "ax_single x_three",
    subject=("right_shoulder",),
    cause=r"lost|silent|not answer|no repl|stopped",
    good=False,
)
def shoulder_lost(story: Story) -> None:
    """The plug of one servo slips out in a motion."""
    story.fault("silence servo={id} at=3s", "right_shoulder")


@case("robot", "ax_single x_fast", cause=r"reached", good=True, first=0)
def goal_reached(story: Story) -> None:
    """A client sends the robot to a pose, and it gets there."""
    story.play()
    story.spec["controllers"]["body"]["tolerances"] = {"goal": "4 deg", "goal_time": "500 ms"}
    pose = {"points": [{"time": 2.0, "positions": [0.26] * 8}]}
    story.asks.append((1.0, "body", "trajectory", pose))
    story.evidence["asked"] += 1


@case("robot", "mx_two x_sync", cause=r"cancel", good=True, first=0)
def goal_cancelled(story: Story) -> None:
    """A client sends a long motion and cancels it half-way."""
    story.play()
    pose = {"points": [{"time": 4.0, "positions": [0.5] * 8}]}
    story.asks += [(0.5, "body", "trajectory", pose), (2.5, "", "cancel", {"controller": "body"})]
    story.evidence["asked"] += 1


@case(
    "robot",
    "mx_bulk x_fast",
    subject=("body",),
    cause=r"rais|fail|fault|exception|ended|\w+Error",
    good=False,
    first=0,
)
def raises_without_fallback(story: Story) -> None:
    """A controller raises in its update, there is no fallback, and the run ends by its policy for faults."""

    def fail(controller: Broken) -> None:
        raise IndexError("list index out of range")

    story.break_controller("body", 2.0, fail)


@case(
    "robot",
    "mx_bulk x_fast",
    subject=("left_knee",),
    cause=r"\bfell|fall(s|en)?\b|tipped|overload|limp|torque",
    first=2,
    good=False,
)
def falls_over_a_limp_knee(story: Story) -> None:
    """A knee trips its overload protection, the robot sinks over it and falls; the reflex takes over."""
    story.upright("left_knee")
    story.motion = story.swing(left_knee="0.25 * sin(1.0 * t)")
    story.joint("left_knee")["simulation"].update(gravity="4 Nm", gravity_angle="180 deg")
    story.fault("overload servo={id} at=2800ms", "left_knee")


@case("robot", "mx_bulk x_fast", cause=r"batter|voltage", first=0, innocents=JOINTS)
def battery_runs_down(story: Story) -> None:
    """The battery is nearly empty: all voltages fall, and the battery controller ends the run."""
    read_slowly(story, 5)
    story.spec["controllers"]["battery"] = {
        "type": "battery_state_broadcaster",
        "voltages": ["left_knee/voltage", "right_knee/voltage"],
        "warn": "11.2 V",
        "stop": "10.7 V",
        "filter": "300 ms",
    }

    def drain(t_s: float) -> None:
        for joint in JOINTS:
            story.servo(joint).voltage = 12.0 - 0.5 * (t_s - 1)
        story.evidence["drained"] += t_s > 3

    story.every(0.05, drain, since_s=1.0)


@case("robot", "mx_two x_sync", subject=("left_knee",), cause=r"abort|path|tolerance", good=False, first=0)
def goal_aborted(story: Story) -> None:
    """A knee is blocked, leaves the path tolerance, and the controller aborts the goal."""
    story.spec["controllers"]["body"]["tolerances"] = {"path": "12 deg"}
    story.fault("jam servo={id} at=2500ms", "left_knee")


@case(
    "robot",
    "mx_bulk x_three",
    subject=("body",),
    cause=r"fallback|stand|took over|takes over",
    word="not good",  # the motion that was to be played is aborted
    first=0,
)
def raises_with_fallback(story: Story) -> None:
    """The walking controller raises an exception, and the fallback that the file declares holds the robot."""
    story.spec["controllers"]["body"]["fallback"] = "stand"
    story.spec["controllers"]["stand"] = {
        "type": "joint_trajectory_controller",
        "joints": list(JOINTS),
        "active": False,
    }

    def fail(controller: Broken) -> None:
        raise ZeroDivisionError("division by zero")

    story.break_controller("body", 2.5, fail)


@case("robot", "mx_bulk x_sync", subject=("left_shoulder",), cause=r"\d deg.*|behind|error|off", first=0)
def motion_played_badly(story: Story) -> None:
    """In a motion a shoulder suddenly carries a heavy bag, and is far behind from then on: the first line
    has it."""

    def bag() -> None:
        plant = story.servo("left_shoulder").shaft.mechanics.plant
        index = story.servo("left_shoulder").shaft.index
        plant._gravity[index], plant._down[index], plant._has_gravity = 1.2, plant.angle[index] - 1.4, True
        story.servo("left_shoulder").shaft.mechanics._wake()
        story.evidence["bag"] += 1

    story.at(2.8, bag, "left_shoulder")


@case(
    "robot",
    "mx_bulk x_three",
    subject=("left_elbow",),
    cause=r"missed|not reached|did not reach|short of",
    first=0,
)
def goal_missed(story: Story) -> None:
    """A goal is missed: a soft joint carries a weight, and ends some degrees beside it."""
    story.spec["controllers"]["body"]["tolerances"] = {"goal": "3 deg", "goal_time": "400 ms"}
    soft = {"position_p_gain": 60} if story.kind.protocol == 2 else {"p_gain": 4}
    story.joint("left_elbow")["registers"] = soft
    story.joint("left_elbow")["simulation"].update(gravity="0.3 Nm", gravity_angle="-90 deg")
    story.at_end(lambda: abs(story.q("left_elbow")) > 0.06, "beside its goal")
    story.duration_s = 5.0
    story.motion = story.swing(left_elbow="0.0 * t")


@case(
    "robot",
    "ax_single x_sync",
    subject=("body",),
    cause=r"nan|not a number|finite",
    word="not good",  # the motion that was to be played is aborted
    first=0,
    innocents=("stand", *JOINTS),
)
def nan_with_fallback(story: Story) -> None:
    """The controller divides by a distance of zero and commands NaN; its fallback takes over, and is
    blameless."""
    story.spec["controllers"]["body"]["fallback"] = "stand"
    story.spec["controllers"]["stand"] = {
        "type": "joint_group_position_controller",
        "joints": list(JOINTS),
        "active": False,
    }

    def fail(controller: Broken) -> None:
        controller.context.commands.position[2] = float("nan")

    story.break_controller("body", 3.0, fail)


@case("robot", "mx_bulk x_fast", cause=r"\bfell|fall(s|en)?\b|tipped", first=0, innocents=JOINTS)
def pushed_over(story: Story) -> None:
    """The robot is tipped over by its motion, and the reflex curls its arms up: the first line says that
    it fell."""
    story.upright("right_knee")
    story.motion = story.swing(right_knee="1.1 * sin(0.5 * t)", hertz=0.1)


@case(
    "robot",
    "mx_two x_sync",
    subject=("right_elbow",),
    cause=r"limp|torque",
    innocents=tuple(joint for joint in JOINTS if joint != "right_elbow"),
    first=0,
)
def torque_off_by_request(story: Story) -> None:
    """A client lets one joint go in a motion, by its request: the joint is limp, and nothing is broken."""
    story.spec["controllers"]["body"]["joints"] = [joint for joint in JOINTS if joint != "right_elbow"]
    story.spec["controllers"]["hand"] = {"type": "joint_group_position_controller", "joints": ["right_elbow"]}
    story.motion = story.swing()
    story.asks.append((2.5, "", "torque", {"joints": ["right_elbow"], "on": False, "release": True}))
    story.at_end(lambda: not story.was_on("right_elbow", 4.0), "limp by request")


@case(
    "robot",
    "x_fast x_three mx_two",
    subject=("left_shoulder",),
    cause=r"reboot|power|brown|start|limp",
    good=False,
)
def reboots_by_itself(story: Story) -> None:
    """The plug of one servo loses power for a moment in a motion: it starts again, and is limp."""
    story.fault("brownout servo={id} at=2600ms for=150ms", "left_shoulder")


@case("robot", "mx_bulk x_three", subject=("body",), cause=r"update|controller|comput|took", innocents=JOINTS)
def controller_is_slow(story: Story) -> None:
    """The controller's update needs several periods now and then: it plans its next step in it."""
    story.slow_controller("body", 1.5, lambda number: 0.025 if number % 25 == 0 else 0.0)


@case(
    "robot",
    "x_fast x_three",
    subject=("right_elbow",),
    cause=r"oscillat|vibrat|\bring|swing|gain|unstable|instab|trembl|overshoot|limit cycle|hunt|shak|chatter"
    r"|back and forth|" + SOFT,
)
def own_gain_too_high(story: Story) -> None:
    """The controller of an elbow by current has a gain far too high and no damping: the elbow swings about
    its goal by itself."""
    controllers = story.spec["controllers"]
    controllers["body"]["joints"].remove("right_elbow")
    controllers["elbow"] = {
        "type": "joint_trajectory_controller",
        "joints": ["right_elbow"],
        "into": ["elbow_pid"],
    }
    controllers["elbow_pid"] = {
        "type": "pid_controller",
        "joints": ["right_elbow"],
        "reference": "position",
        "command_interface": "effort",
        "gains": {"p": 20.0, "i": 150.0, "d": 0.0},
        "integral_limit": 0.8,
    }
    story.joint("right_elbow")["limits"]["effort"] = "1.2 A"
    story.joint("right_elbow")["simulation"]["inertia"] = "0.01 kg m^2"
    story.play(*story.swing()["motions"], *story.swing(0.2, controller="elbow")["motions"])

    def check(log: Log) -> None:
        speed = column(log, "velocity", "right_elbow", 2.5)
        signs = speed[np.abs(speed) > 0.3] > 0
        story.evidence["swings"] += np.count_nonzero(signs[1:] != signs[:-1]) > 8

    story.checks.append(check)


@case(
    "robot",
    "mx_two x_sync",
    cause=r"switch|take[ -]?over|took over|activat|hand(ed|s|ing)?[ -]?(over|back)|flap|alternat"
    r"|back and forth|controllers?\b[^.]*\b(times|client)|client",
    innocents=(*JOINTS, "hardware"),
)
def controllers_flap(story: Story) -> None:
    """Two programs that do not know of each other each claim the arms for their controller, three times a
    second, in turns; the motion never gets on."""
    controllers = story.spec["controllers"]
    controllers["body"]["joints"] = list(others(*ARMS))
    controllers["arms"] = {"type": "joint_trajectory_controller", "joints": list(ARMS)}
    controllers["carry"] = {"type": "joint_group_position_controller", "joints": list(ARMS), "active": False}
    story.play(*story.swing()["motions"], *story.swing(controller="arms")["motions"])
    for number in range(8):
        on, off = ("carry", "arms") if number % 2 == 0 else ("arms", "carry")
        story.asks.append((2.4 + 0.31 * number, "", "switch", {"activate": [on], "deactivate": [off]}))
    said(story, "carry", 6)


@case(
    "robot",
    "mx_two x_fast",
    cause=r"\bstream|\blease|set-?points?|client|stale|no (new )?commands?|without (a )?command"
    r"|commands? .*(stop|late|miss|gap|end)",
    innocents=(*JOINTS, "hardware"),
)
def stream_gasps(story: Story) -> None:
    """The program that streams goals to the arms collects its garbage: three times it sends nothing for
    0.4 s, though its lease is 0.2 s; each time the arms stop dead, and jump on after it."""
    stream_to_arms(
        story,
        200,
        (
            (t_s, [(0.35 + 0.1 * place) * math.sin(2.4 * (t_s - 0.5)) for place in range(len(ARMS))])
            for t_s in np.arange(0.5, 5.2, 0.03).tolist()
            if not any(at_s < t_s < at_s + 0.4 for at_s in (2.4, 3.3, 4.1))
        ),
    )
    said(story, "stream", 3)


@case(
    "log",
    "mx_bulk x_three",
    cause=r"\b(logs?|record\w*|files?)\b.*(\bcut|incomplete|truncat|miss|without|broken|damag|ends?\b|stops?"
    r"|gone|lost|not? (properly )?(closed|complete|finish|whole|footer|summary|index|end))"
    r"|(\bcut|incomplete|truncat|unfinished|lost|missing)\b.*\b(log|record|file)",
    innocents=(*JOINTS, "hardware"),
    good=False,
)
def log_cut(story: Story) -> None:
    """The battery of the computer comes off: of the log the last third is not there, in the middle of a
    chunk."""

    def cut(log: Log) -> None:
        path = story.directory / "run.mcap"
        size = path.stat().st_size
        with path.open("r+b") as file:
            file.truncate(size * 2 // 3 - 7)
        story.evidence["cut"] += path.stat().st_size < size

    story.checks.append(cut)
