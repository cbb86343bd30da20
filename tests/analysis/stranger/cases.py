"""Fault cases, and cases without a fault that only look odd; expectations are what a person would say."""

from __future__ import annotations

from tests.analysis.stranger.expectation import (
    BROKEN,
    HOST,
    STUCK,
    Case,
    collector,
)
from tests.analysis.stranger.kit import JOINTS, MS, Story, freeze

from dxlrun.simulation import ServoConfig

CASES: list[Case] = []
case = collector(CASES)


@case(
    "line",
    "x_fast",
    "x_three",
    cause=r"cut|incomplete|truncat|missing|dropped|short|lost|part of|last",
    good=False,
    innocents=("right_shoulder", "right_elbow", "head_yaw", "left_shoulder", "left_elbow"),
)
def cut_tail(story: Story) -> None:
    """The adapter drops the last bytes of every twelfth shared reply: only the last servo's block is
    spoilt."""
    count = iter(range(10**6))

    def cut(servo_id: int, data: bytes, t_s: float) -> bytes:
        if servo_id != story.id("left_knee") or t_s < 1 or next(count) % 12:
            return data
        story.evidence["tail cut"] += 1
        return data[:-5]

    story.on_arrival("left_knee", cut)


@case(
    "line",
    "x_fast",
    "ax_single",
    "x_sync",
    subject=("bus:left_elbow",),
    cause=r"noise|line|bus|bytes|adapter|cable",
    good=False,
)
def single_bytes_dropped(story: Story) -> None:
    """The adapter loses single bytes now and then, anywhere in what the servos of the line send."""

    def drop(servo_id: int, data: bytes, t_s: float) -> bytes:
        if t_s < 1 or story.random.random() > 0.03:
            return data
        story.evidence["byte dropped"] += 1
        place = story.random.randrange(len(data))
        return data[:place] + data[place + 1 :]

    story.on_arrival("left_elbow", drop)


@case("line", "ax_single", "x_sync", subject=("left_elbow",), cause=BROKEN, good=False)
def second_servo_with_an_id(story: Story) -> None:
    """In a running robot a spare servo with the ID of the elbow is plugged in, and both answer at once."""

    def plug_in() -> None:
        servo = story.servo("left_elbow")
        twin = ServoConfig(servo.servo_id, servo.registers.table.model, servo.position + 0.9, 100_000)
        story.bus("left_elbow").add_servo(twin)
        story.evidence["twin"] += 1

    story.at(2.0, plug_in, "left_elbow")


@case("line", "mx_bulk", "x_sync", "x_three", subject=("right_elbow",), cause=BROKEN, good=False)
def weak_driver(story: Story) -> None:
    """The line driver of one servo is dying: a bit of its replies is wrong now and then, those of others
    never."""

    def flip(data: bytes) -> bytes:
        place = story.random.randrange(2, len(data))
        return data[:place] + bytes((data[place] ^ 1 << story.random.randrange(8),)) + data[place + 1 :]

    story.alter(
        "right_elbow",
        lambda t_s: (flip, 0.0) if t_s > 1 and story.random.random() < 0.15 else None,
        "bit flipped",
    )


@case(
    "line",
    "mx_two",
    "x_three",
    cause=r"hub|host|machine|all (\w+ )?buses|both|several buses|at once|together|USB",
    good=False,
    innocents=JOINTS,
)
def late_hub(story: Story) -> None:
    """All adapters are on one USB hub, which stalls for 12 ms now and then: intact replies of all buses
    are late."""
    buses = range(len(story.spec["buses"]))
    story.hand_over_late(buses, lambda t_s: 0.012 * (t_s > 1.2 and (t_s * 1.7) % 1 < 0.06), "hub late")


@case("line", "mx_bulk", "x_sync", cause=HOST, innocents=JOINTS)
def other_host_reads(story: Story) -> None:
    """A monitor of another program on the same line reads positions ten times a second."""

    def read(t_s: float) -> None:
        bus = story.bus(0)
        joint = story.random.choice(JOINTS)
        bus.other_host(
            story.read(story.id(joint), "present_position"), bus.now_ns + story.random.randrange(8 * MS)
        )
        story.evidence["read"] += 1

    story.every(0.1, read, since_s=1.0)


@case("robot", "mx_bulk", "x_fast", cause=r"(swing|motion|body|trajector).*\d deg", good=True, first=0)
def motion_played(story: Story) -> None:
    """Nothing happens but a motion that all joints follow: the first line has the motion and the worst
    joint."""
    story.evidence["played"] += 1


@case(
    "robot",
    "mx_bulk",
    "x_fast",
    subject=("right_knee",),
    cause=r"overload|limp|no torque|lost its torque|shut",
    good=False,
)
def knee_overloads(story: Story) -> None:
    """A knee trips its overload protection in a motion and is limp from then on."""
    story.fault("overload servo={id} at=2800ms", "right_knee")


@case(
    "robot",
    "ax_single",
    "x_three",
    subject=("right_shoulder",),
    cause=r"lost|silent|not answer|no repl|stopped",
    good=False,
)
def shoulder_lost(story: Story) -> None:
    """The plug of one servo slips out in a motion."""
    story.fault("silence servo={id} at=3s", "right_shoulder")


@case("movement", "mx_bulk", "x_fast", "ax_single", subject=("left_elbow",), cause=STUCK, good=False)
def encoder_frozen(story: Story) -> None:
    """The encoder of an elbow freezes: position to the tick the same, speed 0, while its goal goes on."""
    freeze(story, "left_elbow", 2.4, "present_position")
    story.shown("left_elbow", "present_velocity", lambda show: 0, 2.4)
    story.frozen("left_elbow", 2.5)


@case(
    "movement", "mx_bulk", "x_fast", subject=("left_knee",), cause=r"volt|supply|sag|power|brown", good=None
)
def own_supply_sags(story: Story) -> None:
    """The power plug of one knee has corroded: its own voltage falls with its load, that of no other does."""
    for bus in story.spec["buses"].values():
        bus["slow_registers"] = {
            "rate": 10,
            "items": ["present_voltage" if story.kind.protocol == 1 else "present_input_voltage"],
        }
    story.joint("left_knee")["simulation"].update(gravity="2.0 Nm", gravity_angle="-90 deg")

    def sag(t_s: float) -> None:
        servo = story.servo("left_knee")
        servo.advance(story.bus("left_knee").now_ns)
        servo.voltage = 12.0 - 4.5 * abs(servo.shaft.duty * servo.shaft.current)
        story.evidence["sagged"] += servo.voltage < 10.5
        servo.protect()

    story.every(0.01, sag, "left_knee", since_s=1.0)


@case("innocents", "x_fast", "mx_bulk", subject=("left_knee",), cause=STUCK, good=None, first=2)
def blocked_knee_drags_the_supply(story: Story) -> None:
    """A knee is blocked and draws stall current; the weak battery's voltage falls for all, and all get
    slower."""
    for bus in story.spec["buses"].values():
        bus["slow_registers"] = {"rate": 5}
    story.fault("sag ohms=0.6 at=1s")
    story.fault("jam servo={id} at=2500ms", "left_knee")


@case("fine", "ax_single", "x_sync", good=True)
def one_joint_never_moves(story: Story) -> None:
    """One joint of a motion has the same goal all the time."""
    story.motion = story.swing(left_elbow="0 * t")
    story.evidence["rests"] += 1


@case("fine", "mx_two", "x_three", good=True)
def compliant_from_the_beginning(story: Story) -> None:
    """The file gives one joint a low gain, as for a hand that is to yield."""
    soft = {"position_p_gain": 250} if story.kind.protocol == 2 else {"p_gain": 10}
    story.joint("right_elbow")["registers"] = soft
    story.evidence["soft"] += 1
