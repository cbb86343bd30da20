"""Lines, adapters, cables and other hosts that fail."""

from __future__ import annotations

from functools import partial

import numpy as np
from tests.analysis.stranger.expectation import (
    BROKEN,
    CABLE,
    HARDWARE,
    HOST,
    LATE,
    LOST,
    SHARED,
    VOLTS,
    WAKES,
    Case,
    collector,
    others,
    together,
)
from tests.analysis.stranger.kit import JOINTS, MS, S, Story
from tests.analysis.stranger.proof import seen, unread
from tests.analysis.stranger.world import supply
from tests.kit.line_faults import other_host

from dxlsim.simulation_plan import ServoConfig

CASES: list[Case] = []
case = collector(CASES)


@case(
    "line",
    "x_fast x_three",
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


@case("line", "ax_single x_sync", subject=("left_elbow",), cause=BROKEN, good=False)
def second_servo_with_an_id(story: Story) -> None:
    """In a running robot a spare servo with the ID of the elbow is plugged in, and both answer at once."""

    def plug_in() -> None:
        servo = story.servo("left_elbow")
        twin = ServoConfig(servo.servo_id, servo.registers.table.model, servo.shaft_angle + 0.9, 100_000)
        story.bus("left_elbow").add_servo(twin)
        story.evidence["twin"] += 1

    story.at(2.0, plug_in, "left_elbow")


@case("line", "mx_bulk x_sync x_three", subject=("right_elbow",), cause=BROKEN, good=False)
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
    "mx_two x_three",
    cause=r"hub|host|machine|all (\w+ )?buses|both|several buses|at once|together|USB",
    good=False,
    innocents=JOINTS,
)
def late_hub(story: Story) -> None:
    """All adapters are on one USB hub, which stalls for 12 ms now and then: intact replies of all buses
    are late."""
    buses = range(len(story.spec["buses"]))
    story.hand_over_late(buses, lambda t_s: 0.012 * (t_s > 1.2 and (t_s * 1.7) % 1 < 0.06), "hub late")


@case("line", "mx_bulk x_sync", cause=HOST, innocents=JOINTS)
def other_host_reads(story: Story) -> None:
    """A monitor of another program on the same line reads positions ten times a second."""

    def read(t_s: float) -> None:
        bus = story.bus(0)
        joint = story.random.choice(JOINTS)
        other_host(
            bus, story.read(story.id(joint), "present_position"), bus.now_ns + story.random.randrange(8 * MS)
        )
        story.evidence["read"] += 1

    story.every(0.1, read, since_s=1.0)


@case(
    "line",
    "ax_single x_sync",
    subject=("bus:left_elbow",),
    cause=LATE + r"|latency|timer|adapter",
    good=False,
    innocents=JOINTS,
)
def latency_timer_is_back(story: Story) -> None:
    """A program on the machine sets the adapter's latency timer back to 16 ms while the robot runs."""
    story.fault("timer at=2500ms")


@case(
    "line",
    "ax_single x_fast",
    subject=("left_elbow",),
    cause=r"contact|loose|angle|between -?\d.*deg|at -?\d+ deg",
    good=False,
)
def loose_plug_at_an_angle(story: Story) -> None:
    """The plug of an elbow loses contact whenever the joint is bent to one side."""
    middle = 150 if story.kind.name.startswith("ax") else 180
    story.fault(f"loose servo={{id}} low={middle + 9}deg high={middle + 40}deg at=1s", "left_elbow")


@case(
    "line",
    "mx_bulk x_fast ax_single",
    cause=r"instruction|whole|all (of )?(the |its )?servos|every servo|line|bus|adapter",
    good=False,
    innocents=JOINTS,
)
def instructions_spoilt(story: Story) -> None:
    """The adapter's transmitter is weak: one instruction in twelve arrives with a wrong bit at all servos."""
    story.fault("corrupt from=host byte=3 flip=0x10 packet=200", count=False)

    def spoil(ids: tuple[int, ...], t_s: float) -> None:
        if t_s > 1 and story.random.random() < 0.08:
            story.bus(0).alter_next_instruction("spoilt", lambda data: data[:-1] + bytes((data[-1] ^ 4,)))
            story.evidence["spoilt"] += 1

    story.on_request(0, spoil)


@case(
    "line",
    "mx_bulk x_fast ax_single",
    subject=("left_shoulder", "left_elbow", "left_knee"),
    cause=SHARED,
    good=False,
)
def shared_cable_flickers(story: Story) -> None:
    """The cable to the left side has a bad plug: its three servos are cut off together for moments."""
    breaks = [(t, t + story.random.uniform(0.02, 0.12)) for t in (1.5, 1.9, 2.6, 3.1, 3.15, 3.9, 4.4, 5.2)]

    def contact(joint: str) -> bool:
        open_ = not any(begin <= story.now_s(joint) < end for begin, end in breaks)
        story.evidence["cut off"] += not open_
        return open_

    for joint in ("left_shoulder", "left_elbow", "left_knee"):
        story.at(0.01, partial(story.interrupt, joint, partial(contact, joint)), joint)


@case("line", "ax_single x_three", subject=("bus:left_elbow",), cause=r"nois|garbage|interfer|stray|bytes")
def noise_all_the_time(story: Story) -> None:
    """A motor cable without a ferrite lies along the bus: short bursts of random bytes, all the time."""

    def burst(t_s: float) -> None:
        bus = story.bus("left_elbow")
        data = story.random.randbytes(story.random.randint(1, 6))
        bus.inject_noise(data, bus.now_ns + story.random.randrange(20 * MS))
        story.evidence["burst"] += 1

    story.every(0.05, burst, "left_elbow", since_s=0.8)


@case(
    "line",
    "x_sync ax_single mx_two",
    cause=r"nois|garbage|unasked|sends|stray|bytes|babbl|unrequested",
    innocents=("head_yaw", "head_pitch", "left_shoulder", "left_elbow", "right_shoulder"),
)
def servo_babbles(story: Story) -> None:
    """The firmware of a servo is confused, and it sends rubbish every few milliseconds for a while."""
    story.fault("babble servo={id} at=2s for=700ms every=7ms", "right_elbow")
    story.fault("babble servo={id} at=4s for=500ms every=9ms", "right_elbow")


@case("line", "ax_single x_sync", subject=("left_shoulder",), cause=LATE)
def return_delay_as_shipped(story: Story) -> None:
    """A servo was exchanged for one with another firmware, which takes 2 ms longer for each reply."""
    story.fault("slow servo={id} by=2ms at=1500ms", "left_shoulder")


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


@case("power", "ax_single x_fast", cause=VOLTS, innocents=JOINTS)
def battery_runs_flat(story: Story) -> None:
    """The battery runs flat within the run; nothing has failed yet."""
    story.duration_s = 7.0
    story.motion = story.swing()
    first, last = (11.2, 9.1) if story.kind.protocol == 1.0 else (11.8, 9.7)
    supply(story, 0, lambda t_s, servo: max(last, first - (t_s - 0.9) * (first - last) / 4.5), "flat")
    seen(story, "voltage", "left_knee", lambda values: np.nanmin(values) < last + 0.5)


@case("machine", "mx_two x_fast", cause=WAKES, innocents=HARDWARE)
def job_each_second(story: Story) -> None:
    """Each second a job of the system runs for some 160 ms on the loop's core: in that time the loop wakes by
    half a period to two and a half too late; between the jobs it is in time."""
    period_s = 1 / story.kind.rate

    def by_s(number: int) -> float:
        busy = story.virtual.clock.now_ns() / S % 1.0 < 0.16
        return story.random.uniform(0.5, 2.5) * period_s if busy else 0.0

    story.stall(by_s, 0.9)
    story.at_end(lambda: story.evidence["stall"] > 20, "often late")


@case(
    "host",
    "mx_bulk x_fast",
    cause=HOST + r"|shares? the port|same (port|adapter)|unasked|unrequested|not asked|nobody asked"
    r"|no one asked"
    r"|did not ask|unexpected|stray|replies to|answers? to",
    innocents=JOINTS,
)
def script_reads_by_our_adapter(story: Story) -> None:
    """A script for logging temperatures has the same adapter open and reads all servos in turn, 25 times a
    second: of that only the replies are seen here, which nothing here asked for."""
    numbers = [0]

    def read(t_s: float) -> None:
        bus = story.bus(0)
        joint = JOINTS[numbers[0] % len(JOINTS)]
        numbers[0] += 1
        packet = story.read(story.id(joint), "present_temperature")
        other_host(bus, packet, bus.now_ns + story.random.randrange(9 * MS), received=False)
        story.evidence["read"] += 1

    story.every(0.04, read, 0, 1.3)


@case(
    "robot",
    "mx_two x_fast",
    cause=together(("left_elbow", "right_knee"), LOST),
    innocents=others("left_elbow", "right_knee"),
    good=False,
)
def two_lost_far_apart(story: Story) -> None:
    """Two plugs slip out that have nothing to do with each other: that of an elbow for a second, and later
    that of the other side's knee for good."""
    story.fault("silence servo={id} at=1800ms for=1s", "left_elbow")
    story.fault("silence servo={id} at=3700ms", "right_knee")
    unread(story, "left_elbow", 10)
    unread(story, "right_knee", 20)
