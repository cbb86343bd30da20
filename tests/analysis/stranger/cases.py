"""Fault cases, and cases without a fault that only look odd; expectations are what a person would say."""

from __future__ import annotations

from functools import partial
from typing import Any

from tests.analysis.stranger.expectation import (
    BROKEN,
    HARDWARE,
    HOST,
    LATE,
    MACHINE,
    SOFT,
    STUCK,
    Case,
    collector,
)
from tests.analysis.stranger.kit import JOINTS, MS, Broken, Story, freeze
from tests.analysis.stranger.live import hog_on_the_core_of_the_loop, stop_for_moments

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
    story.joint("left_knee")["simulation"].update(gravity="1.3 Nm", gravity_angle="-90 deg")

    def sag(t_s: float) -> None:
        servo = story.servo("left_knee")
        servo.advance(story.bus("left_knee").now_ns)
        servo.voltage = max(10.2, 12.0 - 7.0 * abs(servo.shaft.duty * servo.shaft.current))
        story.evidence["sagged"] += servo.voltage < 10.8
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


@case("line", "x_fast", "x_sync", subject=("head_pitch",), cause=HOST + r"|torque|limp", good=False, first=2)
def other_host_takes_torque(story: Story) -> None:
    """Another program switches the torque of one servo off, by the same line, in a motion."""

    def write() -> None:
        bus = story.bus("head_pitch")
        bus.other_host(story.write(story.id("head_pitch"), "torque_enable", 0), bus.now_ns + 4 * MS)
        story.evidence["torque taken"] += 0

    def look() -> None:
        story.evidence["torque taken"] += not story.servo("head_pitch").torque_on

    story.at(3.0, write, "head_pitch")
    story.at(3.5, look, "head_pitch")


@case("line", "x_three", "x_sync", cause=HOST, innocents=JOINTS)
def other_host_blinks(story: Story) -> None:
    """A demo of somebody else lets the LEDs of the servos blink, by sync writes at 20 Hz."""

    def blink(t_s: float) -> None:
        bus = story.bus("left_knee")
        joints = [joint for joint in JOINTS if story.bus_name(joint) == bus.name]
        on = int(t_s * 10) % 2
        packet = story.sync_write("led", {story.id(joint): on for joint in joints})
        bus.other_host(packet, bus.now_ns + story.random.randrange(4 * MS))
        story.evidence["blink"] += 1

    story.every(0.05, blink, "left_knee", since_s=1.2)


@case(
    "line",
    "mx_two",
    "x_fast",
    subject=("bus:right_knee",),
    cause=r"nois|garbage|interfer|stray|bytes",
    good=None,
)
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
    "ax_single",
    "x_sync",
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
    "ax_single",
    "x_fast",
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
    "mx_bulk",
    "x_fast",
    "ax_single",
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


@case("line", "ax_single", "x_sync", subject=("right_knee",), cause=LATE, good=None)
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


@case("robot", "ax_single", "x_fast", cause=r"reached", good=True, first=0)
def goal_reached(story: Story) -> None:
    """A client sends the robot to a pose, and it gets there."""
    story.play()
    story.spec["controllers"]["body"]["tolerances"] = {"goal": "4 deg", "goal_time": "500 ms"}
    pose = {"points": [{"time": 2.0, "positions": [0.26] * 8}]}
    story.asks.append((1.0, "body", "trajectory", pose))
    story.evidence["asked"] += 1


@case("robot", "mx_two", "x_sync", cause=r"cancel", good=True, first=0)
def goal_cancelled(story: Story) -> None:
    """A client sends a long motion and cancels it half-way."""
    story.play()
    pose = {"points": [{"time": 4.0, "positions": [0.5] * 8}]}
    story.asks += [(0.5, "body", "trajectory", pose), (2.5, "", "cancel", {"controller": "body"})]
    story.evidence["asked"] += 1


@case(
    "robot",
    "mx_bulk",
    "x_fast",
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
    "mx_bulk",
    "x_fast",
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


@case("robot", "mx_bulk", "x_fast", cause=r"batter|voltage", good=None, first=0, innocents=JOINTS)
def battery_runs_down(story: Story) -> None:
    """The battery is nearly empty: all voltages fall, and the battery controller ends the run."""
    for bus in story.spec["buses"].values():
        bus["slow_registers"] = {"rate": 5}
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


@case(
    "movement",
    "x_three",
    "ax_single",
    subject=("right_elbow",),
    cause=r"slip|jump|implaus|gear|sudden|follow|error|off\b",
    good=None,
)
def gear_jumps_a_tooth(story: Story) -> None:
    """A worn gear lets the joint slip by 20 degrees under load, several times; the servo brings it back."""

    def slip(t_s: float) -> None:
        servo = story.servo("right_elbow")
        servo.shaft.mechanics.place(servo.shaft.index, servo.position + 0.35)
        story.evidence["slip"] += 1

    story.every(0.6, slip, "right_elbow", since_s=2.3)


@case(
    "movement",
    "x_fast",
    "mx_two",
    "ax_single",
    subject=("right_knee",),
    cause=STUCK + r"|behind|limited",
    good=None,
)
def blocked_without_load(story: Story) -> None:
    """A knee is blocked by a cable tie, while its servo gives next to no torque, as its limit is low."""
    item = ("goal_pwm", 60) if story.kind.protocol == 2 else ("torque_limit", 70)
    story.at(1.0, lambda: story.servo("right_knee").poke(*item), "right_knee")
    story.never_overloads("right_knee")
    story.fault("jam servo={id} at=2400ms", "right_knee")


@case(
    "movement",
    "ax_single",
    "x_sync",
    subject=("left_knee",),
    cause=LATE + r"|hot|warm|temperature",
    good=None,
)
def late_when_hot(story: Story) -> None:
    """A knee warms up in the run; above 55 degrees its replies come late, more and more."""
    for bus in story.spec["buses"].values():
        bus["slow_registers"] = {"rate": 4}

    def warm(t_s: float) -> None:
        story.servo("left_knee").temperature = 32 + 7.5 * (t_s - 1)

    story.every(0.1, warm, "left_knee", since_s=1.0)

    def late(t_s: float) -> tuple[Any, float] | None:
        hot = story.servo("left_knee").temperature - 52
        return (bytes, 0.0006 * hot) if hot > 0 else None

    story.alter("left_knee", late, "late and hot")


@case(
    "movement",
    "x_fast",
    "x_sync",
    subject=("left_elbow",),
    cause=r"jump|implaus|revers|direction|drive mode|position|sign|mirror",
    good=None,
)
def counts_backwards(story: Story) -> None:
    """Another tool flips the direction of one servo midway: the same shaft is read with the other sign."""
    story.at(2.4, lambda: story.flip("left_elbow"), "left_elbow")


@case(
    "movement",
    "x_fast",
    "ax_single",
    "mx_two",
    subject=("head_yaw",),
    cause=r"jump|implaus|slip|offset|sudden|shift|\boff\b|error",
    good=None,
)
def encoder_shifts(story: Story) -> None:
    """The magnet of a neck's encoder slips by 25 degrees in a knock; the servo turns until it reads its
    goal again."""

    def shift() -> None:
        servo = story.servo("head_yaw")
        servo.shaft.mechanics.place(servo.shaft.index, servo.position + 0.43)
        story.evidence["shift"] += 1

    story.at(2.8, shift, "head_yaw")


@case(
    "movement",
    "ax_single",
    "x_fast",
    "mx_bulk",
    subject=("left_shoulder",),
    cause=SOFT + r"|torque|limit|PWM|stuck|still",
    good=None,
)
def torque_limit_lowered(story: Story) -> None:
    """Another tool lowers the torque limit of a shoulder midway: it sinks under the weight of the arm."""
    story.never_overloads("left_shoulder")
    story.joint("left_shoulder")["simulation"].update(gravity="0.5 Nm", gravity_angle="-80 deg")

    def lower() -> None:
        servo = story.servo("left_shoulder")
        item, value = ("goal_pwm", 45) if "goal_pwm" in servo.registers else ("torque_limit", 60)
        servo.poke(item, value)
        story.evidence["limit"] += 1

    story.at(2.5, lower, "left_shoulder")


@case(
    "movement",
    "x_fast",
    "mx_bulk",
    "ax_single",
    subject=("left_knee",),
    cause=r"\bhot\b|temperature|heat|warm|deg ?C",
    good=None,
)
def knee_gets_hot(story: Story) -> None:
    """A knee carries too much for long, and gets hotter and hotter until it trips."""
    for bus in story.spec["buses"].values():
        bus["slow_registers"] = {"rate": 4}

    def warm(t_s: float) -> None:
        servo = story.servo("left_knee")
        servo.temperature = 55 + 9.0 * (t_s - 1)
        servo.protect()
        story.evidence["warm"] += 1

    story.every(0.1, warm, "left_knee", since_s=1.0)


@case("innocents", "x_fast", "mx_two", subject=("right_shoulder",), cause=LATE, good=None)
def first_of_the_chain_is_slow(story: Story) -> None:
    """The first servo of a chain is often late; the replies of all behind it are late with it, blameless."""
    story.alter(
        "right_shoulder",
        lambda t_s: (bytes, 0.003) if t_s > 1 and story.random.random() < 0.3 else None,
        "first is late",
    )


@case(
    "innocents",
    "mx_two",
    "x_three",
    subject=("bus:left_knee",),
    cause=r"supply|power|brown|voltage|reboot|start",
    good=False,
    innocents=("right_shoulder", "right_elbow", "right_knee"),
)
def branch_loses_power(story: Story) -> None:
    """The power plug of a limb slips for 150 ms: all its servos start again together; those of others do
    not."""
    story.fault("brownout at=2700ms for=150ms", "left_knee")


@case("innocents", "ax_single", "x_fast", subject=("right_knee",), cause=STUCK, good=None, first=2)
def frozen_while_another_host_pings(story: Story) -> None:
    """A knee is jammed; at the same time a monitor of somebody else pings the line now and then."""
    story.fault("jam servo={id} at=2400ms", "right_knee")

    def ping(t_s: float) -> None:
        bus = story.bus(0)
        bus.other_host(story.ping(story.id("head_yaw")), bus.now_ns + story.random.randrange(8 * MS))
        story.evidence["ping"] += 1

    story.every(0.5, ping, since_s=1.0)


@case("fine", "x_fast", "mx_two", good=True)
def very_fast_motion(story: Story) -> None:
    """All joints move as fast as their limits allow, and lag by what a P control lags."""
    story.motion = story.swing(0.5, 0.75)
    story.evidence["fast"] += 1


@case("fine", "mx_bulk", "x_sync", good=True)
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


@case("fine", "mx_bulk", "x_fast", good=True)
def models_mixed(story: Story) -> None:
    """Different models are on one bus, fast and slow ones."""
    other = ("MX-106", "MX-12W") if story.kind.protocol == 1 else ("XH540-W270", "XL430-W250")
    story.joint("left_shoulder")["model"], story.joint("head_yaw")["model"] = other[0], other[1]
    story.evidence["mixed"] += 1


@case("fine", "mx_bulk", "x_three", good=True)
def paused_and_resumed(story: Story) -> None:
    """A client pauses the run for a second and lets it go on."""
    story.asks += [(2.0, "", "pause", {}), (3.0, "", "resume", {})]
    story.play()
    story.evidence["paused"] += 1


@case("fine", "x_three", "mx_bulk", good=True)
def heavy_limbs(story: Story) -> None:
    """All limbs are heavy, so the supply gives way a little and the joints lag a little, all alike."""
    for joint in JOINTS:
        story.joint(joint)["simulation"].update(inertia="0.01 kg m^2", gravity="0.25 Nm")
    story.fault("sag ohms=0.1 at=100ms")


@case("machine", "x_three", "ax_single", cause=MACHINE, innocents=HARDWARE, live=True)
def hog_on_the_loops_core(story: Story) -> None:
    """A program that never waits is pinned to the core of the loop."""
    story.disturb = hog_on_the_core_of_the_loop


@case("machine", "x_sync", "mx_two", cause=MACHINE, innocents=HARDWARE, live=True)
def loop_is_starved(story: Story) -> None:
    """The loop gets no processor for 25 ms now and then."""
    story.disturb = partial(stop_for_moments, what="loop_process", for_s=0.025, every_s=0.4)
