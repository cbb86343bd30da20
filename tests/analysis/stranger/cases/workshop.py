"""A workshop: spares, tools and programs of others, worn cables, and what only looks odd."""

from __future__ import annotations

from functools import partial

import numpy as np
from tests.analysis.stranger.expectation import HOST, LATE, STUCK, Case, collector, others
from tests.analysis.stranger.kit import JOINTS, S, Story
from tests.analysis.stranger.proof import lags, seen
from tests.analysis.stranger.world import foot_board, poke, supply, voltages_often
from tests.kit.line_faults import other_host

CASES: list[Case] = []
case = collector(CASES)


# Faults


@case("supply", "mx_bulk x_fast", cause=r"volt|supply|\bsag|power", innocents=JOINTS)
def supply_wire_too_thin(story: Story) -> None:
    """A crimp in the supply of all servos heats up: the voltage dips whenever the legs and arms bear load."""
    strong = story.kind.protocol == 2.0
    for name in JOINTS:
        if not name.startswith("head"):
            knee = "knee" in name
            load = (5.0 if knee else 2.0) if strong else (2.5 if knee else 1.1)
            story.joint(name)["simulation"]["gravity"] = f"{load} Nm"
    story.motion = story.swing(amplitude=1.0)
    story.fault("sag ohms=2 at=2s")
    lowest = [99.0]

    def look(t_s: float) -> None:
        lowest[0] = min(lowest[0], story.servo("left_knee").voltage)

    story.every(0.02, look, "left_knee", 2.0)
    story.at_end(lambda: lowest[0] < 10.5, "dip below 10.5 V")


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


@case(
    "servo",
    "x_fast x_three",
    subject=("head_pitch",),
    cause=r"\bmodel|another servo|other servo|W210|1030",
    good=False,
)
def spare_of_another_model(story: Story) -> None:
    """A servo is exchanged in the run, and the spare is an XM430-W210 in place of a W350."""
    story.duration_s = 8.0
    story.motion = story.swing()
    story.fault("silence servo={id} at=2s for=1500ms", "head_pitch")
    story.at(2.6, lambda: story.servo("head_pitch").poke("model_number", 1030), "head_pitch")


@case(
    "setting",
    "x_fast x_sync",
    subject=("right_elbow",),
    cause=r"speed|veloc|slow|profile|follow|behind|lag|track|away from|deviat|error",
    good=False,
)
def profile_velocity_left_by_a_tool(story: Story) -> None:
    """One servo keeps to a speed of 20 deg/s, whatever it is told: it cannot keep up with its goals."""
    story.motion = story.swing(right_elbow="0.5 * sin(2.5 * t)")

    def set_it(t_s: float) -> None:  # the runtime writes the register with each goal
        if story.servo("right_elbow").registers["profile_velocity"] != 15:
            story.servo("right_elbow").poke("profile_velocity", 15)
        story.evidence["profile set"] += 1

    story.every(0.0005, set_it, "right_elbow", 1.5)
    lags(story, "right_elbow", 0.09, 1.6)


@case(
    "setting",
    "mx_bulk ax_single",
    subject=("left_shoulder",),
    cause=r"torque|weak|overload|limp|follow|behind|lag|track|away from|deviat|not? (once )?mov|stuck",
    good=False,
)
def torque_limit_of_a_bench_test(story: Story) -> None:
    """One servo has a Torque Limit of 6 % from a test on the bench: it does not lift its arm."""
    story.joint("left_shoulder")["simulation"]["gravity"] = "0.8 Nm"
    story.motion = story.swing(left_shoulder="0.5 * sin(2 * t)")

    def set_it() -> None:
        story.servo("left_shoulder").poke("torque_limit", 60)
        story.evidence["limit set"] += 1

    story.at(1.5, set_it, "left_shoulder")
    lags(story, "left_shoulder", 0.07, 1.6)


@case(
    "mechanics",
    "mx_two x_fast",
    subject=("left_elbow",),
    cause=r"block|stop|stuck|jam|obstacle|one side|beyond|follow|overload|behind|away from|short of|deviat",
    good=False,
)
def cable_tie_stops_the_elbow(story: Story) -> None:
    """A cable tie is too tight: an elbow gets to 7 deg and not a tick further, but freely back."""
    story.motion = story.swing(left_elbow="0.5 * sin(2 * t)")
    stop = 0.12

    def hold(t_s: float) -> None:
        servo = story.servo("left_elbow")
        if story.q("left_elbow") > stop:
            servo.shaft.mechanics.place(servo.shaft.index, np.pi + stop)
            story.evidence["stopped"] += 1

    story.evidence["stopped"] += 0
    story.every(0.002, hold, "left_elbow", 1.0)
    lags(story, "left_elbow", 0.09)


@case(
    "adapter",
    "x_three",
    subject=("bus:left_knee", "bus:right_knee"),
    cause=r"\blate|adapter|hub|USB|delay|latency|machine|shared?|together|same (time|moment)",
    innocents=(*JOINTS, "bus:head_yaw"),
)
def two_adapters_behind_a_busy_hub(story: Story) -> None:
    """A camera shares the USB hub with two adapters: again and again both hand bytes over 12 ms late."""

    def late_s(t_s: float) -> float:
        return 0.012 if t_s > 1.5 and t_s % 0.8 < 0.1 else 0.0

    story.hand_over_late(("left_knee", "right_knee"), late_s, "held in the hub")


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
    "host",
    "x_three x_fast",
    subject=("head_pitch",),
    cause=r"torque|limp|follow|away from|stood still|stands? still|not mov|another|foreign|stuck",
    good=False,
)
def torque_off_by_another_program(story: Story) -> None:
    """Another program opens the same adapter for a moment and switches off the torque of one servo."""
    story.motion = story.swing(head_pitch="0.5 * sin(2 * t)")

    def off() -> None:
        bus = story.bus("head_pitch")
        packet = story.write(story.id("head_pitch"), "torque_enable", 0)
        other_host(bus, packet, bus.now_ns + 1000, received=False)

    story.at(2.803, off, "head_pitch")
    story.at_end(lambda: not story.servo("head_pitch").torque_on, "torque off")


@case(
    "program",
    "mx_bulk x_three",
    subject=("body",),
    cause=r"took|takes?|long|slow|\bms\b|overr|late|update",
    innocents=(*JOINTS, "hardware"),
    good=False,
)
def controller_gets_slower(story: Story) -> None:
    """A controller keeps a list that it searches in each update: each takes 50 us longer than the last."""
    story.slow_controller("body", 1.5, lambda number: 50e-6 * number)


@case(
    "cable",
    "mx_bulk x_sync",
    cause=r"noise|interfer|corrupt|garbl|checksum|CRC|damag|spoil|disturb|stray|unasked|no servo",
    innocents=others("left_knee"),
)
def motor_disturbs_the_line(story: Story) -> None:
    """The data line runs along the leads of a big motor: while the left knee is fast, stray bytes appear."""
    story.motion = story.swing(left_knee="0.5 * sin(2 * t)")

    def stray(t_s: float) -> None:
        servo, bus = story.servo("left_knee"), story.bus("left_knee")
        if abs(servo.velocity) > 0.5 and story.random.random() < 0.15:
            bus.inject_noise(story.random.randbytes(3), bus.now_ns)
            story.evidence["noise"] += 1

    story.evidence["noise"] += 0
    story.every(0.002, stray, "left_knee", 1.5)


@case(
    "mechanics",
    "ax_single x_sync",
    subject=("right_shoulder",),
    cause=r"\bhot|heat|temperature|°C|degC|deg C|warm",
    good=False,
)
def servo_cooks_in_its_shell(story: Story) -> None:
    """A servo in a closed shell becomes hotter and hotter, until it shuts itself down."""

    def warm(t_s: float) -> None:
        story.servo("right_shoulder").set_temperature(min(90.0, 50.0 + 9.0 * (t_s - 0.5)))
        story.evidence["warmer"] += 1

    story.every(0.25, warm, "right_shoulder", 0.5)
    story.at_end(lambda: not story.servo("right_shoulder").torque_on, "shut down")


@case(
    "setting",
    "mx_two x_three",
    innocents=others("left_knee", "head_yaw"),
    cause=r"baud|\btool|wrote|writ(es|ten|ing)|unrequested|unasked|" + HOST,
    good=False,
)
def baud_rate_written(story: Story) -> None:
    """A setup tool on the same line takes the torque of a knee and sets its baud rate to 57600; then the
    knee hears nothing of the line."""
    value = 34 if story.kind.protocol == 1.0 else 1

    def plan() -> None:
        for t_s, item, wire in ((2.6012, "torque_enable", 0), (2.6512, "baud_rate", value)):
            packet = story.write(story.id("left_knee"), item, wire)
            other_host(story.bus("left_knee"), packet, round(t_s * S))

    story.prepared.append(plan)
    story.at_end(lambda: story.servo("left_knee").baud_rate < 60_000, "listens at another rate")


@case(
    "setting",
    "ax_single x_sync",
    subject=("right_elbow",),
    cause=LATE + r"|return delay|longer|later",
)
def return_delay_at_factory(story: Story) -> None:
    """The Return Delay Time of an elbow goes back to the 500 us of the factory, while the robot moves."""
    story.at(2.5, lambda: poke(story, "right_elbow", return_delay_time=250), "right_elbow")


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


@case(
    "adapter",
    "mx_two x_three",
    subject=("bus:left_knee",),
    cause=r"latency|adapter|timer|USB|held back|holds? back|hands? (it |them )?over|burst|FTDI|buffer|"
    + LATE,
    good=False,
    first=2,
    innocents=("left_shoulder", "left_elbow", "left_knee"),
)
def timer_and_charger(story: Story) -> None:
    """Two at once. Another program that opens the adapter of the left side sets its latency timer back to
    16 ms midway; and a charger for a battery of more cells lets the voltage of the right side creep up to
    more than its servos may have."""
    voltages_often(story)
    story.fault("timer at=2700ms by=16ms", "left_knee")
    supply(
        story, "right_knee", lambda t_s, servo: min(17.0, 12.0 + 2.0 * (t_s - 2.2)), "charged", since_s=2.2
    )
    seen(story, "voltage", "right_knee", lambda values: np.nanmax(values) > 16.5)


# What only looks odd


@case("fine", "mx_bulk x_sync", good=True)
def only_the_head_moves(story: Story) -> None:
    """The motion moves the head alone: six joints do not move by a tick in the whole run."""
    story.motion = story.swing(**{name: "0 * t" for name in JOINTS if not name.startswith("head")})
    story.evidence["played"] += 1


@case("fine", "mx_two x_fast", good=True)
def head_led_by_hand(story: Story) -> None:
    """The head's joints have `torque: off` in the robot file, for teaching, and a hand turns them."""
    for name in ("head_yaw", "head_pitch"):
        story.joint(name)["torque"] = "off"
        story.fault("turn servo={id} by=30deg at=2s for=1s", name)
    story.spec["controllers"]["body"]["joints"] = [name for name in JOINTS if not name.startswith("head")]
    story.motion = story.swing()


@case("fine", "mx_bulk x_three", good=True)
def warm_from_the_run_before(story: Story) -> None:
    """All servos are at 50 degrees C from a run before, far below their limits."""

    def warm() -> None:
        for name in JOINTS:
            story.servo(name).temperature = 50.0
        story.evidence["warm"] += 1

    story.at(0.01, warm)


@case("fine", "ax_single mx_two", good=True)
def client_changes_its_mind(story: Story) -> None:
    """A client sends the robot to a pose, and to another one before it is there."""
    story.play()
    first = {"points": [{"time": 3.0, "positions": [0.5] * 8}]}
    second = {"points": [{"time": 2.0, "positions": [-0.2] * 8}]}
    story.asks += [(1.0, "body", "trajectory", first), (2.2, "body", "trajectory", second)]
    story.evidence["asked"] += 1
