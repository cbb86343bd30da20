"""Faults of the line, of adapters and of other hosts."""

from __future__ import annotations

from functools import partial

from tests.analysis.stranger.expectation import BROKEN, HOST, LATE, SHARED, Case, collector
from tests.analysis.stranger.kit import JOINTS, MS, Story
from tests.kit.line_faults import other_host

from dxlrun.plan.simulation_plan import ServoConfig

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


@case(
    "line",
    "x_fast ax_single x_sync",
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


@case("line", "ax_single x_sync", subject=("left_elbow",), cause=BROKEN, good=False)
def second_servo_with_an_id(story: Story) -> None:
    """In a running robot a spare servo with the ID of the elbow is plugged in, and both answer at once."""

    def plug_in() -> None:
        servo = story.servo("left_elbow")
        twin = ServoConfig(servo.servo_id, servo.registers.table.model, servo.position + 0.9, 100_000)
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


@case("line", "x_fast x_sync", subject=("head_pitch",), cause=HOST + r"|torque|limp", good=False, first=2)
def other_host_takes_torque(story: Story) -> None:
    """Another program switches the torque of one servo off, by the same line, in a motion."""

    def write() -> None:
        bus = story.bus("head_pitch")
        other_host(bus, story.write(story.id("head_pitch"), "torque_enable", 0), bus.now_ns + 4 * MS)
        story.evidence["torque taken"] += 0

    def look() -> None:
        story.evidence["torque taken"] += not story.servo("head_pitch").torque_on

    story.at(3.0, write, "head_pitch")
    story.at(3.5, look, "head_pitch")


@case("line", "x_three x_sync", cause=HOST, innocents=JOINTS)
def other_host_blinks(story: Story) -> None:
    """Another program's demo lets the LEDs of the servos blink, by sync writes at 20 Hz."""

    def blink(t_s: float) -> None:
        bus = story.bus("left_knee")
        joints = [joint for joint in JOINTS if story.bus_name(joint) == bus.name]
        on = int(t_s * 10) % 2
        packet = story.sync_write("led", {story.id(joint): on for joint in joints})
        other_host(bus, packet, bus.now_ns + story.random.randrange(4 * MS))
        story.evidence["blink"] += 1

    story.every(0.05, blink, "left_knee", since_s=1.2)


@case("line", "mx_two x_fast", subject=("bus:right_knee",), cause=r"nois|garbage|interfer|stray|bytes")
def noise_under_load(story: Story) -> None:
    """The line picks up noise only while the big motors work hard: it comes with the motion, not before."""
    story.joint("right_knee")["simulation"]["inertia"] = "0.02 kg m^2"

    def burst(t_s: float) -> None:
        bus = story.bus("right_knee")
        servo = story.servo("right_knee")
        if abs(servo.shaft.duty) < 0.1:
            return
        bus.inject_noise(story.random.randbytes(2), bus.now_ns + story.random.randrange(5 * MS))
        story.evidence["burst"] += 1

    story.every(0.01, burst, "right_knee", since_s=0.8)


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


@case("line", "ax_single x_sync", subject=("right_knee",), cause=LATE)
def late_now_and_then(story: Story) -> None:
    """One servo is busy with itself now and then: a tenth of its replies come some milliseconds late,
    intact."""
    story.alter(
        "right_knee",
        lambda t_s: (
            (bytes, story.random.uniform(0.002, 0.006)) if t_s > 1 and story.random.random() < 0.1 else None
        ),
        "late",
    )


@case(
    "line",
    "x_fast mx_bulk",
    subject=("left_shoulder",),
    cause=r"cut|incomplete|truncat|missing|broken|lost|silent|not answer|repl",
    good=False,
)
def cut_in_the_middle(story: Story) -> None:
    """A servo in the middle of the chain breaks off its own block; those behind it then wait in vain."""
    story.alter(
        "left_shoulder",
        lambda t_s: (lambda data: data[:4], 0.0) if t_s > 1.5 and story.random.random() < 0.12 else None,
        "block broken off",
    )


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


@case(
    "line",
    "x_sync mx_bulk",
    subject=("right_shoulder", "right_elbow", "right_knee"),
    cause=SHARED,
    good=False,
)
def leg_cable_torn(story: Story) -> None:
    """The cable to the right side is torn off in a motion: three servos are gone for good, at the same
    moment."""
    for joint in ("right_shoulder", "right_elbow", "right_knee"):
        story.fault("silence servo={id} at=2700ms", joint)


@case(
    "line",
    "mx_two x_three",
    subject=("bus:left_knee",),
    cause=LATE + r"|adapter|latency|held|hub",
    good=False,
)
def late_adapter(story: Story) -> None:
    """One adapter of several hands intact replies over some milliseconds late, in bursts."""
    story.hand_over_late(
        ["left_knee"], lambda t_s: 0.011 * (t_s > 1.5 and (t_s * 2.3) % 1 < 0.12), "bus late"
    )


@case("line", "ax_single x_fast", cause=HOST, innocents=JOINTS)
def other_host_pings(story: Story) -> None:
    """A second adapter on the line scans it: another program pings one ID after the other."""
    count = iter(range(10**6))

    def ping(t_s: float) -> None:
        bus = story.bus(0)
        other_host(bus, story.ping(next(count) % 60), bus.now_ns + story.random.randrange(9 * MS))
        story.evidence["ping"] += 1

    story.every(0.12, ping, since_s=1.0)


@case(
    "line",
    "ax_single mx_bulk",
    cause=HOST + r"|\bID\b.*chang|lost|not answer",
    subject=("right_elbow",),
    good=False,
    first=2,
)
def other_host_changes_an_id(story: Story) -> None:
    """A tool sets up a servo while the robot runs, and the new ID goes to the wrong one."""

    def write() -> None:
        bus = story.bus("right_elbow")
        other_host(bus, story.write(story.id("right_elbow"), "torque_enable", 0), bus.now_ns + 2 * MS)
        other_host(bus, story.write(story.id("right_elbow"), "id", 77), bus.now_ns + 6 * MS)
        story.at_end(lambda: any(servo.servo_id == 77 for servo in bus.servos), "ID changed")

    story.at(2.5, write, "right_elbow")


@case("line", "mx_bulk x_fast", cause=HOST, innocents=JOINTS)
def other_host_commands(story: Story) -> None:
    """A second program was left running, and sends its own goal positions to all servos by sync writes."""

    def goals(t_s: float) -> None:
        bus = story.bus(0)
        data = {story.id(joint): 2048 + story.random.randrange(-150, 150) for joint in JOINTS}
        other_host(bus, story.sync_write("goal_position", data), bus.now_ns + story.random.randrange(9 * MS))
        story.evidence["goals"] += 1

    story.every(0.25, goals, since_s=1.5)


@case(
    "line",
    "mx_bulk x_fast",
    cause=r"echo|own (bytes|instructions|packets|data)|(it|host) sen[dt]",
    innocents=JOINTS,
)
def adapter_begins_to_echo(story: Story) -> None:
    """The direction switch of the adapter fails: from then on the host receives what it sends."""

    def begin() -> None:
        story.bus(0).echo = True
        story.evidence["echo"] += 1

    story.at(2.5, begin)


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
    "mx_two x_three",
    subject=("bus:left_knee",),
    cause=r"adapter|port|unplug|gone|disconnect|USB",
    good=False,
)
def adapter_unplugged(story: Story) -> None:
    """A USB plug slips out for half a second in a motion, and is pushed in again."""
    story.fault("unplug at=2500ms for=500ms", "left_knee")


@case(
    "line",
    "mx_bulk x_three",
    subject=("bus:right_knee",),
    cause=r"adapter|whole bus|all (of )?(the |its )?servos|every servo|line|bus",
    good=False,
    innocents=JOINTS,
)
def adapter_hangs(story: Story) -> None:
    """The adapter hangs for 400 ms: it takes bytes and gives none."""
    story.fault("wedge at=3s for=400ms", "right_knee")


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
