"""What happens to a robot: falls, faults of controllers and clients, sensors; and what only happens."""

from __future__ import annotations

from typing import Any

from tests.analysis.stranger.expectation import HARDWARE, Case, collector
from tests.analysis.stranger.kit import JOINTS, Broken, Story
from tests.analysis.stranger.proof import seen, spread
from tests.analysis.stranger.world import imu_gives, noisy_imu

from dxlrun.log.log_reader import Log

CASES: list[Case] = []
case = collector(CASES)


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


@case("robot", "mx_two x_sync", subject=("left_knee",), cause=r"abort|path|tolerance", good=False, first=0)
def goal_aborted(story: Story) -> None:
    """A knee is blocked, leaves the path tolerance, and the controller aborts the goal."""
    story.spec["controllers"]["body"]["tolerances"] = {"path": "12 deg"}
    story.fault("jam servo={id} at=2500ms", "left_knee")


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


@case(
    "client", "ax_single x_three", subject=("left_knee",), cause=r"torque|limp|\boff\b|releas|switch|client"
)
def wrong_knee_made_limp(story: Story) -> None:
    """A client switches off the torque of the wrong knee in the middle of a motion."""
    story.asks.append((2.5, "", "torque", {"joints": ["left_knee"], "on": False, "release": True}))
    story.at_end(lambda: not story.was_on("left_knee", 3.5), "off")


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


@case("fine", "mx_bulk x_fast", good=True, innocents=HARDWARE)
def one_reply_in_a_run_is_lost(story: Story) -> None:
    """Of thousands of replies one is lost, and the next one comes: that happens on the best of lines."""
    story.fault("lose servo={id} at=2600ms", "right_elbow")


@case("fine", "ax_single x_three", good=True, innocents=HARDWARE)
def moves_less_than_a_tick(story: Story) -> None:
    """A breathing motion of hundredths of a degree: the goals change, the positions cannot."""
    story.motion = story.swing(**dict.fromkeys(JOINTS, "0.0006 * sin(1.3 * t)"))
    seen(story, "goal_position", "left_knee", lambda values: 0 < spread(values) < 0.02)
