"""Data lines, plugs and cables, adapters, and the power of servos."""

from __future__ import annotations

import numpy as np
from tests.analysis.stranger.expectation import (
    CABLE,
    GARBLED,
    LOST,
    REBOOTS,
    VOLTS,
    Case,
    collector,
    others,
    together,
)
from tests.analysis.stranger.kit import HEAD, JOINTS, LEFT, MS, RIGHT, S, Story
from tests.analysis.stranger.proof import seen, unread
from tests.analysis.stranger.world import noisy_imu, supply

from dxlrun.simulation.servo.simulated_servo import SimulatedServo

CASES: list[Case] = []
case = collector(CASES)


# Lines


@case(
    "line",
    "mx_two x_three",
    subject=("bus:left_knee",),
    cause=together(
        (
            *("bus", "line", "adapter", "cable", "port", "servos", "joints"),
            *("all", "every", "together", "same", "at once"),
        ),
        r"silent|lost|short|stuck|\blow\b|zero|answer|repl|held|dead|" + GARBLED,
    ),
    innocents=others(*LEFT, "head_yaw"),
    good=False,
)
def line_held_low(story: Story) -> None:
    """A crushed cable pulls the data line of one bus to ground for most of a second: the host receives zeros,
    and no servo is heard."""

    def held() -> bool:
        return 2.5 < story.now_s("left_knee") < 3.3

    def plan() -> None:
        for servo in story.bus("left_knee").servos:
            servo.interrupt(lambda: not held())

    def zeros(t_s: float) -> None:
        if held():
            story.evidence["held"] += 1
            story.bus("left_knee").inject_noise(bytes(20), story.bus("left_knee").now_ns)

    story.prepared.append(plan)
    story.every(0.003, zeros, "left_knee")
    for joint in LEFT:
        unread(story, joint, 10)


@case(
    "line",
    "mx_bulk x_fast",
    cause=r"\becho|own (bytes|packets?|instructions?|requests?|words)|itself|(comes?|came|sent|given) back"
    r"|loop(ed)? ?back",
    innocents=JOINTS,
)
def echo_begins(story: Story) -> None:
    """The adapter's receiver is no longer switched off while it sends: from a moment on the host hears its
    own bytes."""

    def begin() -> None:
        story.bus(0).echo = True
        story.evidence["echo"] += 1

    story.at(2.2, begin)
    story.at_end(lambda: any(each.note == "echo" for each in story.bus(0).ledger.entries), "heard")


@case(
    "line",
    "mx_two x_fast",
    cause=GARBLED + r"|extra|bytes?\b|turn.?around|direction|driver|glitch",
    innocents=JOINTS,
)
def stray_byte_at_the_turnaround(story: Story) -> None:
    """The driver lets the line float when it turns around: before half of the replies is a byte that no servo
    sent; no reply is lost by it."""

    def add(servo_id: int, data: bytes, t_s: float) -> bytes:
        if t_s < 0.8 or story.random.random() > 0.5 or not data.startswith(b"\xff\xff"):
            return data
        story.evidence["added"] += 1
        return b"\x00" + data

    for number in story.buses:
        story.on_arrival(number, add)


@case("line", "ax_single x_fast", cause=GARBLED, innocents=JOINTS)
def noise_grows_with_the_load(story: Story) -> None:
    """The data ground is the motors' ground: the more current they draw, the more replies are spoilt."""
    for joint in (*LEFT, *RIGHT):
        story.joint(joint)["simulation"] |= {"gravity": "0.5 Nm"}
    story.motion = story.swing(0.8)

    def spoil(servo_id: int, data: bytes, t_s: float) -> bytes:
        drawn = sum(abs(servo.shaft.current) for servo in story.bus(0).servos)
        if t_s < 1.0 or len(data) < 4 or story.random.random() > 0.09 * drawn:
            return data
        story.evidence["spoilt"] += 1
        place = story.random.randrange(len(data))
        return data[:place] + bytes([data[place] ^ 1 << story.random.randrange(8)]) + data[place + 1 :]

    story.on_arrival(0, spoil)
    story.at_end(lambda: story.evidence["spoilt"] > 15, "enough spoilt")


@case(
    "line",
    "ax_single x_three",
    cause=GARBLED + r"|drop|lost|miss|short|cut|byte|overrun|overflow",
    innocents=JOINTS,
)
def bytes_fall_out(story: Story) -> None:
    """A cheap adapter loses single bytes in the middle of replies, of all servos alike."""

    def drop(servo_id: int, data: bytes, t_s: float) -> bytes:
        if t_s < 1.0 or len(data) < 4 or story.random.random() > 0.05:
            return data
        story.evidence["dropped"] += 1
        place = story.random.randrange(len(data))
        return data[:place] + data[place + 1 :]

    for number in story.buses:
        story.on_arrival(number, drop)


@case(
    "line",
    "ax_single x_fast",
    subject=("right_knee",),
    cause=GARBLED + r"|send|babbl|talk|" + CABLE + "|" + LOST,
)
def one_transmitter_is_weak(story: Story) -> None:
    """The transmitter of one servo no longer pulls the line down for certain: in its replies, and in those
    alone, zeros become ones."""

    def weak(servo_id: int, data: bytes, t_s: float) -> bytes:
        if t_s < 1.0 or servo_id != story.id("right_knee") or story.random.random() > 0.3:
            return data
        story.evidence["weak"] += 1
        place = story.random.randrange(len(data) // 2, len(data))
        return data[:place] + bytes([data[place] | 0x5A]) + data[place + 1 :]

    story.on_arrival(0, weak)


# Plugs and cables


@case("cable", "mx_two x_fast", subject=("right_shoulder",), cause=REBOOTS + "|" + CABLE, good=False)
def power_pin_at_an_angle(story: Story) -> None:
    """Of a plug the power pin alone is loose: at one angle the servo starts again, its data are sound."""
    story.spec["policies"] = {"on_returned_servo": "hold"}
    story.motion = story.swing(right_shoulder="0.5 * sin(2.2 * t)")
    inside = False

    def look(t_s: float) -> None:
        nonlocal inside
        was, inside = inside, 0.2 < story.q("right_shoulder") < 0.3
        if inside and not was:
            story.evidence["cut"] += 1
            story.servo("right_shoulder").cut_power(story.bus("right_shoulder").now_ns + 60 * MS)

    story.every(0.01, look, "right_shoulder", 1.3)


@case("cable", "ax_single x_three", subject=("left_knee",), cause=CABLE + "|" + LOST)
def contact_fails_when_it_moves_fast(story: Story) -> None:
    """A plug that shakes: a knee answers when it moves slowly, and often not when it is fast, at whatever
    angle."""
    story.motion = story.swing(left_knee="0.45 * sin(3.4 * t)")

    def contact() -> bool:
        shaken = abs(story.servo("left_knee").velocity) > 1.0 and story.random.random() < 0.35
        story.evidence["shaken"] += shaken
        return not shaken

    story.prepared.append(lambda: story.interrupt("left_knee", contact))
    unread(story, "left_knee", 5)


@case(
    "cable",
    "mx_bulk x_fast",
    cause=together(LEFT, CABLE + "|" + LOST + r"|angle|together|same time"),
    innocents=(*RIGHT, *HEAD),
)
def chain_behind_the_shoulder(story: Story) -> None:
    """The cable through a shoulder is pulled when the shoulder is up: elbow and knee behind it lose contact,
    whatever they do themselves."""
    story.motion = story.swing(left_shoulder="0.5 * sin(2.2 * t)")

    def contact() -> bool:
        whole = story.q("left_shoulder") < 0.25 or story.now_s("left_shoulder") < 1.2
        story.evidence["pulled"] += not whole
        return whole

    def plan() -> None:
        for joint in ("left_elbow", "left_knee"):
            story.interrupt(joint, contact)

    story.prepared.append(plan)
    unread(story, "left_elbow", 10)
    unread(story, "left_knee", 10)


@case("robot", "mx_bulk x_fast", subject=("head_yaw",), cause=LOST + "|" + CABLE, good=False, first=2)
def falls_and_tears_a_cable(story: Story) -> None:
    """The robot falls, which tears the plug of the head: two things, one of which follows the other."""
    story.upright("right_knee")
    noisy_imu(story)
    story.duration_s = 5.0
    story.motion = story.swing(right_knee="1.2 * sin(0.8 * t)", left_knee="0.2 * sin(1.5 * t)")
    story.fault("silence servo={id} at=3200ms", "head_yaw")
    unread(story, "head_yaw", 20)


# Adapters


@case(
    "adapter",
    "mx_two x_three",
    cause=together(
        ("hub", "USB", "adapter", "port", "bus"),
        r"unplug|disconnect|gone|vanish|disappear|lost|closed|away|re-?open|anew|hub|together|same|at once"
        r"|\ball\b|both",
    ),
    innocents=JOINTS,
    good=False,
)
def hub_starts_anew(story: Story) -> None:
    """A static discharge: the USB hub starts anew, all adapters vanish in one moment and come back."""
    for number in story.buses:
        story.fault("unplug at=2800ms for=350ms", number)


@case(
    "adapter",
    "mx_two x_three",
    subject=("bus:left_knee",),
    cause=r"unplug|adapter|\bport\b|USB|gone|disconnect|plug|cable|\bbus\b|vanish|away",
    innocents=JOINTS,
    good=False,
)
def foot_on_one_usb_cable(story: Story) -> None:
    """A foot catches the cable of one of the adapters, twice."""
    story.fault("unplug at=2s for=150ms", "left_knee")
    story.fault("unplug at=4s for=150ms", "left_knee")


@case(
    "adapter",
    "mx_bulk x_fast",
    cause=r"\blate|slow|delay|latency|adapter|after its|USB|timer|wait|time.?out",
    innocents=JOINTS,
)
def adapter_dozes(story: Story) -> None:
    """The adapter saves power: now and then a reply is handed over some milliseconds late, at no fixed time,
    of whichever servo."""
    last = 0.0

    def doze(t_s: float) -> float:
        nonlocal last
        if t_s > 1.0 and t_s > last + 0.05 and story.random.random() < 0.04:
            last = t_s
            return story.random.uniform(0.002, 0.007)
        return 0.0

    story.hand_over_late((0,), doze, "dozed")
    story.at_end(lambda: story.evidence["dozed"] > 8, "enough dozed")


@case(
    "host",
    "ax_single x_fast",
    cause=r"(another|second|other) (program|process|reader)|shares? the port|incomplet|\bcut\b|bytes|"
    + LOST
    + "|"
    + GARBLED,
    innocents=JOINTS,
)
def second_reader_eats_replies(story: Story) -> None:
    """A second program has the port open and reads from it now and then: what it reads is missing here, of
    whichever servo."""

    def eat(servo_id: int, data: bytes, t_s: float) -> bytes:
        if t_s < 1.0 or t_s % 0.7 > 0.25 or story.random.random() > 0.45:
            return data
        story.evidence["eaten"] += 1
        return data[story.random.randrange(1, len(data) + 1) :]

    story.on_arrival(0, eat)
    story.at_end(lambda: story.evidence["eaten"] > 15, "enough eaten")


# Power


@case("power", "ax_single x_fast", cause=VOLTS, innocents=JOINTS)
def battery_runs_flat(story: Story) -> None:
    """The battery runs flat within the run; nothing has failed yet."""
    story.duration_s = 7.0
    story.motion = story.swing()
    first, last = (11.2, 9.1) if story.kind.protocol == 1.0 else (11.8, 9.7)
    supply(story, 0, lambda t_s, servo: max(last, first - (t_s - 0.9) * (first - last) / 4.5), "flat")
    seen(story, "voltage", "left_knee", lambda values: np.nanmin(values) < last + 0.5)


@case("power", "mx_two x_fast", subject=("left_knee",), cause=VOLTS + "|" + CABLE)
def corroded_crimp(story: Story) -> None:
    """A corroded crimp: whenever one knee draws current, its own voltage falls, and that of no other."""
    story.duration_s = 8.0
    story.joint("left_knee")["simulation"] |= {"gravity": "1.6 Nm"}
    story.motion = story.swing(left_knee="0.9 + 0.4 * sin(2.3 * t)")

    def fallen(t_s: float, servo: SimulatedServo) -> float | None:
        if servo.servo_id != story.id("left_knee"):
            return None
        return max(9.8, 12.0 - 4.5 * abs(servo.shaft.current))

    supply(story, "left_knee", fallen, "fallen")
    seen(story, "voltage", "left_knee", lambda values: np.nanmin(values) < 10.8)


@case("power", "mx_bulk x_three", cause=VOLTS, innocents=JOINTS)
def supply_rises_when_braking(story: Story) -> None:
    """The supply takes nothing back: when the limbs brake, its voltage rises above what the servos allow."""
    for number in story.buses:
        supply(story, number, lambda t_s, servo: 17.1 if t_s % 1.3 < 0.65 and t_s > 1.5 else 12.0, "high")
    seen(story, "voltage", "left_knee", lambda values: np.nanmax(values) > 16.5)


@case("power", "mx_two x_fast", cause=VOLTS + "|" + REBOOTS, innocents=JOINTS, good=False)
def all_start_again_as_they_take_up_load(story: Story) -> None:
    """A supply that is too small: as all joints begin to move it breaks down, and all servos start again."""
    for number in story.buses:
        story.fault("brownout at=1500ms for=120ms", number)


@case(
    "power",
    "mx_bulk x_fast",
    cause=together(
        LEFT,
        r"together|same|at once|(three|\b3) (servos|joints)|shar|common|power|suppl|fuse|branch"
        r"|left_shoulder.*left_knee",
    ),
    innocents=(*RIGHT, *HEAD),
    good=False,
)
def left_arm_goes_dark(story: Story) -> None:
    """The fuse of one limb: its three servos are without power from one moment on, in the middle of the
    chain."""

    def dark() -> None:
        for joint in LEFT:
            story.servo(joint).cut_power(60 * S)
            story.evidence["dark"] += 1

    story.at(3.0, dark, "left_shoulder")
    for joint in LEFT:
        unread(story, joint, 20)
