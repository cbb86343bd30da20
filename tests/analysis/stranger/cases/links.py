"""What lies between the loop and its servos: a machine, its adapters and other programs, lines and power."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from tests.analysis.stranger.expectation import (
    BROKEN,
    CABLE,
    GARBLED,
    HARDWARE,
    HEAT,
    HOST,
    LATE,
    LOAD,
    LOST,
    SHARED,
    VOLTS,
    WAKES,
    WEAK,
    Case,
    collector,
    others,
    together,
)
from tests.analysis.stranger.kit import HEAD, JOINTS, LEFT, MS, RIGHT, S, Story, stronger
from tests.analysis.stranger.proof import lags, seen, spread, unread
from tests.analysis.stranger.world import cut_tails, heats, late_wakes, poke, supply, voltages_often
from tests.kit.line_faults import other_host

from dxlrun.simulation.servo.simulated_servo import SimulatedServo

CASES: list[Case] = []
case = collector(CASES)


# Machine and adapters


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
    "machine",
    "mx_bulk x_fast",
    cause=WAKES,
    innocents=HARDWARE,
)
def no_core_from_the_start(story: Story) -> None:
    """A simulation in the background takes all cores from before the start on: more than a third of the
    loop's wakes come late, by up to one and a half periods, all the time."""
    period_s = 1 / story.kind.rate
    late_wakes(story, 0.2, 99.0, 0.37, (0.3 * period_s, 1.5 * period_s))
    story.at_end(lambda: story.evidence["stall"] > 60, "often late")


@case(
    "adapter",
    "mx_two x_three",
    cause=r"hub|host|machine|USB|adapters|all (\w+ )?buses|both|several buses|every bus"
    r"|at once|together|same time",
    innocents=JOINTS,
)
def webcam_on_the_hub(story: Story) -> None:
    """A webcam streams by the same USB hub as all adapters from the beginning on: seven times a second what
    the servos sent is handed over 9 ms late, on all buses at once, for some 30 ms."""
    story.hand_over_late(story.buses, lambda t_s: 0.009 * (t_s > 0.8 and t_s % 0.143 < 0.03), "hub late")


@case(
    "line",
    "mx_bulk x_fast",
    cause=r"\bcut\b|incomplete|truncat|missing|dropped|short|part of|tail|rest of|bytes|adapter|USB|buffer|"
    + LOST
    + "|"
    + GARBLED,
    innocents=JOINTS,
)
def usb_packet_lost(story: Story) -> None:
    """The adapter's driver loses a USB packet now and then: of the replies of one cycle in fourteen the rest
    is missing, from some byte in the middle on. All servos have sent all of it."""
    cut_tails(story, 0, 0.07, range(30, 95), 1.0)
    story.at_end(lambda: story.evidence["tails cut"] > 15, "enough cut")


# Other hosts


@case(
    "host",
    "mx_bulk x_fast",
    subject=("left_shoulder",),
    cause=HOST + r"|gain|" + WEAK,
    innocents=others("left_shoulder"),
    first=2,
)
def tuning_gui_on_the_same_line(story: Story) -> None:
    """A colleague's tuning GUI hangs on the same line: it reads the P gain of a shoulder a few times, then
    writes an eighth of it; the shoulder sinks under its arm and stays soft."""
    item = "p_gain" if story.kind.protocol == 1.0 else "position_p_gain"
    story.joint("left_shoulder")["simulation"]["gravity"] = "0.9 Nm"
    story.motion = story.swing(left_shoulder="0.7 + 0.3 * sin(1.9 * t)")

    def gui() -> None:
        bus, number = story.bus("left_shoulder"), story.id("left_shoulder")
        for place in range(4):
            at_ns = bus.now_ns + round(0.1 * place * S) + story.random.randrange(8 * MS)
            other_host(bus, story.read(number, item), at_ns)
        value = max(1, story.servo("left_shoulder").registers[item] // 8)
        other_host(bus, story.write(number, item, value), bus.now_ns + round(0.5 * S) + 3 * MS)
        story.evidence["GUI"] += 1

    story.at(2.1, gui, "left_shoulder")
    story.at_end(lambda: story.servo("left_shoulder").registers[item] < 110, "gain written")
    lags(story, "left_shoulder", 0.09, 2.7)


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


# Lines and cables


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


@case(
    "line",
    "mx_two x_fast",
    cause=together(
        ("head_yaw", "left_knee"),
        BROKEN + "|" + LOST + "|" + GARBLED + r"|collision|\bIDs?\b|another",
    ),
    innocents=others("head_yaw", "left_knee"),
    good=False,
)
def neck_takes_the_knees_id(story: Story) -> None:
    """A tool of a student gives the servo of the neck the ID of a knee, in a running robot: under the neck's
    ID no servo answers any more, and under the knee's two do at once."""

    def renumber() -> None:
        poke(story, "head_yaw", id=story.id("left_knee"))

    story.at(2.6, renumber, "head_yaw")
    story.at_end(
        lambda: sum(one.servo_id == story.id("left_knee") for one in story.bus("left_knee").servos) == 2,
        "two with one ID",
    )
    unread(story, "head_yaw", 20)


@case(
    "cable",
    "mx_bulk x_fast",
    cause=together(HEAD, SHARED + "|" + CABLE + "|" + LOST),
    innocents=(*LEFT, *RIGHT),
)
def neck_cable_frays(story: Story) -> None:
    """The cable through the neck frays from the beginning on: some three times a second both servos of the
    head are cut off, together, for 20 to 60 ms; all others, before and behind them, are sound."""
    breaks = []
    at_s = 0.95
    while at_s < 6.0:
        breaks.append((at_s, at_s + story.random.uniform(0.02, 0.06)))
        at_s += story.random.uniform(0.2, 0.5)

    def contact() -> bool:
        whole = not any(begin <= story.now_s(0) < end for begin, end in breaks)
        story.evidence["cut off"] += not whole
        return whole

    def plan() -> None:
        for joint in HEAD:
            story.interrupt(joint, contact)

    story.prepared.append(plan)
    for joint in HEAD:
        unread(story, joint, 10)


@case(
    "line",
    "ax_single x_fast",
    subject=("right_elbow",),
    cause=BROKEN + "|" + GARBLED + "|" + LOST + "|" + HEAT,
)
def clock_drifts_when_warm(story: Story) -> None:
    """The oscillator of one servo drifts as it gets warm: above 45 degrees C bits of its replies are wrong,
    the more the warmer, up to a third of them at 70 degrees."""
    heats(story, "right_elbow", lambda t_s: min(70.0, 36.0 + 9.0 * (t_s - 0.9)))

    def flip(data: bytes) -> bytes:
        place = story.random.randrange(len(data) // 2, len(data))
        return data[:place] + bytes((data[place] ^ 1 << story.random.randrange(8),)) + data[place + 1 :]

    def drifts(t_s: float) -> tuple[Callable[[bytes], bytes], float] | None:
        share = (story.servo("right_elbow").temperature - 45.0) / 75.0
        return (flip, 0.0) if t_s > 1.0 and story.random.random() < share else None

    story.alter("right_elbow", drifts, "bit wrong")
    story.at_end(lambda: story.evidence["bit wrong"] > 12, "often")


@case("line", "ax_single x_fast", subject=("right_knee",), cause=LATE + "|" + LOAD)
def late_under_load(story: Story) -> None:
    """The firmware of a knee is busy with its current control: whenever the knee bears much load its replies
    come 3 to 5 ms late, intact; unloaded they are in time."""
    story.joint("right_knee")["simulation"]["gravity"] = f"{stronger(story, 0.9, 5.0)} Nm"
    story.motion = story.swing(right_knee="0.5 * sin(1.9 * t)")

    def late(t_s: float) -> tuple[Callable[[bytes], bytes], float] | None:
        loaded = abs(story.servo("right_knee").shaft.duty) > 0.15
        return (bytes, story.random.uniform(0.003, 0.005)) if t_s > 0.9 and loaded else None

    story.alter("right_knee", late, "late and loaded")
    story.at_end(lambda: story.evidence["late and loaded"] > 20, "often")


# Power


@case("power", "mx_two x_three", cause=VOLTS, innocents=JOINTS)
def a_cell_dies(story: Story) -> None:
    """A cell of the battery dies in the run: from one moment to the next all servos have 8.7 V in place of
    11.8 V, and keep it."""
    for number in story.buses:
        supply(story, number, lambda t_s, servo: 11.8 if t_s < 3.1 else 8.7, "supplied", since_s=0.1)
    seen(story, "voltage", "left_knee", lambda values: np.nanmin(values) < 9.2)
    seen(story, "voltage", "right_elbow", lambda values: np.nanmin(values) < 9.2)


@case("movement", "ax_single x_three", subject=("right_shoulder",), cause=VOLTS + "|" + CABLE)
def thin_pigtail(story: Story) -> None:
    """One shoulder hangs on a supply wire that is far too thin, from the beginning on: whenever it lifts its
    arm its own voltage falls by some 2 V, that of all others stays."""
    voltages_often(story)
    story.joint("right_shoulder")["simulation"]["gravity"] = f"{stronger(story, 0.7, 2.4)} Nm"
    story.motion = story.swing(right_shoulder="0.5 + 0.5 * sin(2.0 * t)")
    normal: list[float] = []

    def fallen(t_s: float, servo: SimulatedServo) -> float | None:
        if servo.servo_id != story.id("right_shoulder"):
            return None
        normal[:] = normal or [servo.voltage]
        return max(9.7, normal[0] - stronger(story, 7.0, 5.0) * abs(servo.shaft.current))

    supply(story, "right_shoulder", fallen, "fallen")
    seen(story, "voltage", "right_shoulder", lambda values: spread(values[values > 0]) > 1.5)
    seen(story, "voltage", "right_elbow", lambda values: spread(values[values > 0]) < 0.8)
