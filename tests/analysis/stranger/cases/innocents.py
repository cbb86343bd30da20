"""Machines and supplies that fail, two faults at once, and robots that are well."""

from __future__ import annotations

import os
from functools import partial

from tests.analysis.stranger.expectation import HARDWARE, HOST, LATE, MACHINE, SILENT, STUCK, Case, collector
from tests.analysis.stranger.kit import JOINTS, MS, Story
from tests.analysis.stranger.live import compile_jobs, hog_on_the_core_of_the_loop, stop_for_moments
from tests.analysis.stranger.world import foot_board, read_slowly
from tests.kit.line_faults import other_host

CASES: list[Case] = []
case = collector(CASES)


@case("innocents", "x_fast mx_bulk", subject=("left_knee",), cause=STUCK, first=2)
def blocked_knee_drags_the_supply(story: Story) -> None:
    """A knee is blocked and draws stall current; the weak battery's voltage falls for all, and all get
    slower."""
    read_slowly(story, 5)
    story.fault("sag ohms=0.6 at=1s")
    story.fault("jam servo={id} at=2500ms", "left_knee")


@case("fine", "mx_two x_three", good=True)
def compliant_from_the_beginning(story: Story) -> None:
    """The file gives one joint a low gain, as for a hand that is to yield."""
    soft = {"position_p_gain": 250} if story.kind.protocol == 2 else {"p_gain": 10}
    story.joint("right_elbow")["registers"] = soft
    story.evidence["soft"] += 1


@case("innocents", "x_fast mx_two", subject=("right_shoulder",), cause=LATE)
def first_of_the_chain_is_slow(story: Story) -> None:
    """The first servo of a chain is often late; the replies of all behind it are late with it, blameless."""
    story.alter(
        "right_shoulder",
        lambda t_s: (bytes, 0.003) if t_s > 1 and story.random.random() < 0.3 else None,
        "first is late",
    )


@case(
    "innocents",
    "mx_two x_three",
    subject=("bus:left_knee",),
    cause=r"supply|power|brown|voltage|reboot|start",
    good=False,
    innocents=("right_shoulder", "right_elbow", "right_knee"),
)
def branch_loses_power(story: Story) -> None:
    """The power plug of a limb slips for 150 ms: all its servos start again together; those of others do
    not."""
    story.fault("brownout at=2700ms for=150ms", "left_knee")


@case("innocents", "ax_single x_fast", subject=("right_knee",), cause=STUCK, first=2)
def frozen_while_another_host_pings(story: Story) -> None:
    """A knee is jammed; at the same time another program pings the line now and then."""
    story.fault("jam servo={id} at=2400ms", "right_knee")

    def ping(t_s: float) -> None:
        bus = story.bus(0)
        other_host(bus, story.ping(story.id("head_yaw")), bus.now_ns + story.random.randrange(8 * MS))
        story.evidence["ping"] += 1

    story.every(0.5, ping, since_s=1.0)


@case("fine", "x_fast mx_two", good=True)
def very_fast_motion(story: Story) -> None:
    """All joints move as fast as their limits allow, and lag by what a P control lags."""
    story.motion = story.swing(0.5, 0.75)
    story.evidence["fast"] += 1


@case("fine", "mx_bulk x_three", good=True)
def paused_and_resumed(story: Story) -> None:
    """A client pauses the run for a second and lets it continue."""
    story.asks += [(2.0, "", "pause", {}), (3.0, "", "resume", {})]
    story.play()
    story.evidence["paused"] += 1


@case("machine", "x_three ax_single", cause=MACHINE, innocents=HARDWARE, live=True)
def hog_on_the_loops_core(story: Story) -> None:
    """A program that never waits is pinned to the core of the loop."""
    story.disturb = hog_on_the_core_of_the_loop


@case("machine", "x_sync mx_two", cause=MACHINE, innocents=HARDWARE, live=True)
def loop_is_starved(story: Story) -> None:
    """The loop gets no processor for 25 ms now and then."""
    story.disturb = partial(stop_for_moments, what="loop_process", for_s=0.025, every_s=0.4)


@case("innocents", "x_fast mx_two x_three", subject=("right_shoulder",), cause=SILENT, good=False)
def head_of_the_chain_is_silent(story: Story) -> None:
    """The first servo of a chain misses every eighth instruction; all behind it then wait in vain,
    blameless."""
    count = iter(range(10**6))

    def contact() -> bool:
        open_ = story.now_s("right_shoulder") < 1 or next(count) % 8 != 0
        story.evidence["silent"] += not open_
        return open_

    story.at(0.01, lambda: story.interrupt("right_shoulder", contact), "right_shoulder")


@case("fine", "mx_bulk x_fast", good=True)
def carries_a_weight(story: Story) -> None:
    """One joint carries a weight, so that its P control leaves a larger steady error than that of its
    peers."""
    story.joint("left_shoulder")["simulation"].update(gravity="0.5 Nm", gravity_angle="-90 deg")
    story.evidence["carries"] += 1


@case(
    "innocents",
    "mx_bulk x_fast",
    cause=r"machine|wake|stall|paus|process|late|period|scheduled",
    innocents=JOINTS,
)
def machine_stalls_in_a_motion(story: Story) -> None:
    """The machine stops for 60 ms now and then, as one that swaps does: the loop wakes late, servos are
    blameless."""
    story.stall(lambda number: 0.06 if number % 37 == 0 else 0.0, 1.5)


@case("fine", "mx_bulk x_three", good=True)
def very_slow_motion(story: Story) -> None:
    """All joints creep: a tick or so in some cycles."""
    story.motion = story.swing(0.05, 0.03)
    story.evidence["creeps"] += 1


@case("fine", "x_fast x_three", good=True)
def reboot_by_request(story: Story) -> None:
    """A client reboots a servo, as after an overload; it comes back with its torque."""
    story.spec["controllers"]["body"]["joints"] = [joint for joint in JOINTS if joint != "head_pitch"]
    story.motion = story.swing()
    story.asks.append((2.0, "", "reboot", {"joints": ["head_pitch"], "release": True}))
    story.at_end(lambda: story.noted("reboot", "head_pitch"), "rebooted")


@case("machine", "x_fast mx_bulk", cause=MACHINE, innocents=HARDWARE, live=True)
def compiler_beside(story: Story) -> None:
    """A compile job with one process more than there are cores runs beside the loop."""
    story.disturb = partial(compile_jobs, count=os.cpu_count() + 1)


@case("machine", "x_fast ax_single", cause=MACHINE, innocents=HARDWARE, live=True)
def simulation_is_starved(story: Story) -> None:
    """The process of the simulated servos gets no processor for 120 ms, again and again."""
    story.disturb = partial(stop_for_moments, what="simulation_process", for_s=0.12, every_s=0.7)


@case(
    "cable",
    "mx_bulk x_fast",
    subject=("left_shoulder", "left_elbow", "left_knee"),
    cause=r"together|same|at once|shared?|common|cable|power|supply|behind",
    good=False,
)
def board_of_left_arm_dark(story: Story) -> None:
    """The fuse of the distribution board that feeds three servos blows: all three are dark at one moment."""
    for joint in ("left_shoulder", "left_elbow", "left_knee"):
        story.fault("brownout servo={id} at=3s for=20s", joint)


@case("host", "mx_bulk x_sync", cause=HOST, innocents=JOINTS)
def wizard_scans_the_line(story: Story) -> None:
    """A colleague's laptop on the same line scans for servos: a ping of the next ID every 20 ms."""
    numbers = iter(range(1, 250))

    def scan(t_s: float) -> None:
        bus = story.bus(0)
        other_host(bus, story.ping(next(numbers)), bus.now_ns + 1000)
        story.evidence["ping"] += 1

    story.every(0.02, scan, 0, 2.0)


@case(
    "device",
    "mx_bulk x_fast",
    subject=("foot",),
    cause=STUCK
    + r"|constant|no longer chang|not chang|unchang|same (value|reading|number)|hang|hung|dead|repeat|flat",
)
def foot_board_hangs(story: Story) -> None:
    """The board in a foot answers every read, but its converter has hung: all its forces, which trembled by
    some steps before, are the same to the bit from then on."""
    foot_board(story)

    def hang() -> None:
        registers = story.bus(0).device(101).registers
        kept = {name: show() for name, show in registers._live.items()}
        registers.show_live({name: partial(int, wire) for name, wire in kept.items()})
        story.evidence["hangs"] += 1

    story.at(2.6, hang)
