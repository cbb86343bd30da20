"""What only looks like a fault, faults that drag others along, and a busy machine."""

from __future__ import annotations

import os
from functools import partial

from tests.analysis.stranger.expectation import HARDWARE, LATE, MACHINE, SILENT, STUCK, Case, collector
from tests.analysis.stranger.kit import JOINTS, MS, Story
from tests.analysis.stranger.live import compile_jobs, hog_on_the_core_of_the_loop, stop_for_moments
from tests.analysis.stranger.proof import said
from tests.analysis.stranger.world import late_wakes, read_slowly, supply, voltages_often
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


@case("fine", "ax_single x_sync", good=True)
def one_joint_never_moves(story: Story) -> None:
    """One joint of a motion has the same goal all the time."""
    story.motion = story.swing(left_elbow="0 * t")
    story.evidence["rests"] += 1


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


@case("fine", "mx_bulk x_sync", good=True)
def jerky_trajectory(story: Story) -> None:
    """A trajectory of jerks: another pose every 300 ms, with straight ways in between."""
    random = story.random
    points = [
        {
            "time": f"{0.3 * number:.1f} s",
            "joints": {joint: {"position": f"{random.uniform(-9, 9):.1f} deg"} for joint in JOINTS},
        }
        for number in range(1, 12)
    ]
    story.play({"controller": "body", "points": points})
    story.evidence["jerks"] += 1


@case("fine", "mx_bulk x_fast", good=True)
def models_mixed(story: Story) -> None:
    """Different models are on one bus, fast and slow ones."""
    other = ("MX-106", "MX-12W") if story.kind.protocol == 1 else ("XH540-W270", "XL430-W250")
    story.joint("left_shoulder")["model"], story.joint("head_yaw")["model"] = other[0], other[1]
    story.evidence["mixed"] += 1


@case("fine", "mx_bulk x_three", good=True)
def paused_and_resumed(story: Story) -> None:
    """A client pauses the run for a second and lets it go on."""
    story.asks += [(2.0, "", "pause", {}), (3.0, "", "resume", {})]
    story.play()
    story.evidence["paused"] += 1


@case("fine", "x_three mx_bulk", good=True)
def heavy_limbs(story: Story) -> None:
    """All limbs are heavy, so the supply gives way a little and the joints lag a little, all alike."""
    for joint in JOINTS:
        story.joint(joint)["simulation"].update(inertia="0.01 kg m^2", gravity="0.25 Nm")
    story.fault("sag ohms=0.1 at=100ms")


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


@case("fine", "ax_single x_fast", good=True)
def idle_robot(story: Story) -> None:
    """A robot that holds its pose, and plays nothing."""
    story.play()
    story.evidence["idle"] += 1


@case("innocents", "ax_single x_fast", subject=("left_knee",), cause=r"overload|limp|torque|shut", good=False)
def limp_on_a_noisy_bus(story: Story) -> None:
    """A knee trips its overload protection; at the same time the line is a little noisy, as ever."""
    story.fault("overload servo={id} at=2500ms", "left_knee")

    def burst(t_s: float) -> None:
        bus = story.bus("left_knee")
        bus.inject_noise(story.random.randbytes(3), bus.now_ns + story.random.randrange(20 * MS))
        story.evidence["burst"] += 1

    story.every(0.4, burst, "left_knee", since_s=0.8)


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


@case(
    "innocents",
    "mx_bulk x_fast x_sync",
    subject=("left_elbow",),
    cause=SILENT + r"|contact|cable|plug|loose",
    good=False,
)
def broken_wire_amid_the_chain(story: Story) -> None:
    """The signal wire of an elbow in the middle of a chain breaks at one angle: those behind it wait in
    vain."""
    story.fault("loose servo={id} low=186deg high=215deg at=1s share=0.5", "left_elbow")


@case("fine", "mx_bulk x_three", good=True)
def very_slow_motion(story: Story) -> None:
    """All joints creep: a tick or so in some cycles."""
    story.motion = story.swing(0.05, 0.03)
    story.evidence["creeps"] += 1


@case("fine", "ax_single x_fast", good=True)
def rests_at_its_limit(story: Story) -> None:
    """One joint goes to its position limit, and stays there for seconds."""
    story.joint("head_pitch")["limits"]["position"] = ["-120 deg", "0.5 rad"]
    story.motion = story.swing(head_pitch="min(0.5, 0.4 * t)")
    story.evidence["at its limit"] += 1


@case("fine", "mx_two x_sync ax_single", good=True)
def hand_turns_a_limp_joint(story: Story) -> None:
    """A joint that the file leaves limp is turned by a hand, back and forth."""
    story.joint("head_yaw")["torque"] = "off"
    story.spec["controllers"]["body"]["joints"] = [joint for joint in JOINTS if joint != "head_yaw"]
    story.motion = story.swing()
    story.fault("turn servo={id} by=35deg for=1s at=1500ms", "head_yaw")
    story.fault("turn servo={id} by=-50deg for=900ms at=3500ms", "head_yaw")


@case("fine", "x_fast x_three", good=True)
def reboot_by_request(story: Story) -> None:
    """A client reboots a servo, as after an overload; it comes back with its torque."""
    story.spec["controllers"]["body"]["joints"] = [joint for joint in JOINTS if joint != "head_pitch"]
    story.motion = story.swing()
    story.asks.append((2.0, "", "reboot", {"joints": ["head_pitch"], "release": True}))
    story.at_end(lambda: story.noted("reboot", "head_pitch"), "rebooted")


@case("fine", "ax_single mx_two", good=True)
def controllers_switched(story: Story) -> None:
    """A client switches to another controller half-way, and back."""
    story.spec["controllers"]["hold"] = {
        "type": "joint_group_position_controller",
        "joints": list(JOINTS),
        "active": False,
    }
    story.play()
    there = {"activate": ["hold"], "deactivate": ["body"]}
    back = {"activate": ["body"], "deactivate": ["hold"]}
    story.asks += [(2.0, "", "switch", there), (3.5, "", "switch", back)]
    story.evidence["switched"] += 1


@case("machine", "x_fast mx_bulk", cause=MACHINE, innocents=HARDWARE, live=True)
def compiler_beside(story: Story) -> None:
    """A compile job with one process more than there are cores runs beside the loop."""
    story.disturb = partial(compile_jobs, count=os.cpu_count() + 1)


@case("machine", "x_fast ax_single", cause=MACHINE, innocents=HARDWARE, live=True)
def simulation_is_starved(story: Story) -> None:
    """The process of the simulated servos gets no processor for 120 ms, again and again."""
    story.disturb = partial(stop_for_moments, what="dxlrun.simulation", for_s=0.12, every_s=0.7)


@case(
    "machine",
    "ax_single x_fast",
    cause=MACHINE + r"|wak|woke|late|sched|deadline|jitter|clock|overrun|skipp",
    innocents=HARDWARE,
)
def slow_core_in_motion(story: Story) -> None:
    """The machine saves power: its core is so slow while more has to be computed, that is while the motion
    plays, that a quarter of the wakes come late; before and behind it all is in time."""
    story.duration_s = 7.0
    story.motion = story.swing()
    story.motion["motions"][0]["duration"] = "2.5 s"
    period_s = 1 / story.kind.rate
    late_wakes(story, 2.0, 4.5, 0.25, (0.4 * period_s, 1.3 * period_s))


@case("fine", "mx_two x_fast", innocents=(*JOINTS, "hardware"))
def paused_in_a_motion(story: Story) -> None:
    """A client pauses the run in the middle of a motion, and lets it go on after a second."""
    story.duration_s = 8.0
    story.motion = story.swing()
    story.motion["motions"][0]["duration"] = "4 s"
    story.asks += [(3.1, "", "pause", {}), (4.1, "", "resume", {})]
    said(story, "resume")


@case("fine", "mx_bulk x_three", innocents=(*JOINTS, "hardware"))
def half_the_rate(story: Story) -> None:
    """A client lets the loop run at half its rate for a while."""
    rate = story.kind.rate
    story.asks += [(2.6, "", "rate", {"rate": rate / 2}), (4.0, "", "rate", {"rate": rate})]
    story.checks.append(lambda log: story.evidence.update(slower=int(len(log.cycles) < 5.5 * rate)))


@case("fine", "ax_single x_sync", innocents=(*JOINTS, "hardware"))
def taught_by_hand(story: Story) -> None:
    """A joint without torque, as the robot file asks for it, is turned by a hand, there and back, while the
    others play a motion."""
    story.joint("right_elbow")["torque"] = False
    story.spec["controllers"]["body"]["joints"].remove("right_elbow")
    story.motion = story.swing()
    story.fault("turn servo={id} by=35deg for=900ms at=2300ms", "right_elbow")
    story.fault("turn servo={id} by=-25deg for=700ms at=3600ms", "right_elbow")
    story.at_end(lambda: abs(story.q("right_elbow")) > 0.1, "turned")


@case("fine", "mx_two x_sync", innocents=(*JOINTS, "hardware"))
def from_battery_to_mains(story: Story) -> None:
    """The robot is taken from its battery to a power supply while it moves: 11.3 V, then at once 12.4 V, each
    of them good."""
    voltages_often(story)
    for number in story.buses:
        supply(story, number, lambda t_s, servo: 11.3 if t_s < 3.2 else 12.4, "supplied", since_s=0.1)
