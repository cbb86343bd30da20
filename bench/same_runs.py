"""Do two trees do the same? 200 random runs on virtual time, the same again from their numbers, as hashes.

    python same_runs.py TREE OUT.json [NUMBER ...]   run them in TREE, by its .venv; of numbers texts too
    python same_runs.py BEFORE.json AFTER.json       print what differs; exit code 1: of the wire, the log

Half of the runs are robots of TREE/robots with their motions, half are robots of random servos of both
protocols with random goals; most have faults and commands of a client; every fourth is recorded. Of each
there are the hashes of what passed the simulated lines (bytes with their times), of notes in the ledger, and
of each topic of the log.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import tempfile
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

RUNS = 200
WORDS = ("notes", "topic /events", "topic /rosout", "topic /diagnostics", "error")
"""What may differ where only sentences changed."""
PLAYED = """bioloid_torso three_parts; bioloid_torso_imu three_parts; bioloid_torso_keyframes;
bioloid_torso_whole_body whole_body_trajectory; bioloid_torso_whole_body whole_body_posvel
trajectory:=false posvel:=true; bioloid_torso_whole_body whole_body_position trajectory:=false
position:=true; diff_drive diff_drive_square base:=false wheels:=true; diff_drive; effort_arm
effort_arm_lift; fall_reflex fall_reflex_tip; fall_reflex; held_arm held_arm_reach; humanoid_20
humanoid_20_squat rate:=200; humanoid_20 humanoid_20_squat rate:=500 adapter:=ftdi;
leader_follower leader_follower_wave; leader_follower left_arm:=false leader_torque:=off;
mechanics mechanics_reach; mechanics mechanics_reach physics:=mujoco; open_manipulator_x
open_manipulator_x_wave; single_joint single_joint_step_position position_trajectory:=false
position:=true; single_joint single_joint_step_posvel position_trajectory:=false posvel:=true;
single_joint single_joint_tracking position_trajectory:=false posvel_trajectory:=true;
single_joint_feed_forward; single_joint_learning single_joint_learning; single_joint_learning
single_joint_learning interface:=posvel; wolfgang wolfgang_squat rate:=50; wolfgang
wolfgang_squat baud:=2000000"""
KINDS = (
    *("lose", "corrupt", "truncate", "delay", "duplicate", "noise", "silence", "babble"),
    *("reboot", "brownout", "voltage", "other_model", "overload", "overheat", "turn", "duplicate_id"),
    *("loose", "lossy", "slow", "jam", "sag", "timer", "unplug", "wedge"),
)
MODELS = {
    1.0: ("AX-12A", "AX-18A", "MX-28", "MX-64", "MX-106", "RX-28", "EX-106+"),
    2.0: (
        "XL430-W250",
        "XM430-W350",
        "XM540-W270",
        "XL330-M288",
        "XC330-M288",
        "XL-320",
        "MX-64(2.0)",
        "PH42-020-S300-R",
    ),
}


def shipped(random: Random, tree: Path, directory: Path) -> tuple[Path, dict[str, str], list[Path]]:
    """Return a robot of the tree, its arguments, and its motion."""
    name, *rest = random.choice(PLAYED.split(";")).split()
    arguments = dict(word.split(":=") for word in rest if ":=" in word)
    motions = [Path(f"robots/motions/{word}.yaml") for word in rest if ":=" not in word]
    os.chdir(tree)  # the log has the names of files
    return Path(f"robots/{name}.yaml"), arguments, motions


def made(random: Random, tree: Path, directory: Path) -> tuple[Path, dict[str, str], list[Path]]:
    """Write a robot of random servos on one or two buses, and a motion for it."""
    buses, joints, moves, groups = [], [], [], defaultdict(list)
    for bus in ("main", "other")[: random.choice((1, 1, 2))]:
        protocol = random.choice((1.0, 2.0))
        baud, delay = random.choice((57_600, 1_000_000, 1_000_000)), random.choice((0, 100, 500))
        split, absent = random.choice(("whole", "byte", "random")), random.choice(("silent", "slot"))
        simulated = f"split: {split}, absent: {absent}"
        timer = random.choice(("", "", ", latency_timer: 2 ms"))
        buses.append(
            f"  {bus}: {{port: sim, protocol: {protocol}, baud_rate: {baud}, return_delay_time: {delay} us, "
            f"adapter: {{latency: {3 if timer else 1} ms}}, simulation: {{{simulated}{timer}}}}}"
        )
        for servo_id in sorted(random.sample(range(1, 60), random.randint(1, 6))):
            joint, model = (
                f"{bus}_{servo_id}",
                random.choice(MODELS[protocol][: 1 if baud == 57_600 else None]),
            )
            given = {
                "inertia": "0.01 kg m^2",
                "friction": "0.05 Nm",
                "gravity": "0.2 Nm",
                "gravity_angle": "-40 deg",
            }
            given |= {"response_delay": "5 ms", "write_time": "200 us"}
            load = ", ".join(f"{key}: {value}" for key, value in given.items() if random.random() < 0.25)
            joints.append(
                f"  {joint}: {{bus: {bus}, id: {servo_id}, model: {model}, reference: 150 deg, "
                f"direction: {random.choice((1, -1))}, "
                "limits: {position: [-100 deg, 100 deg], velocity: 4 rad/s}, "
                f"simulation: {{{load}}}}}"
            )
            groups[random.choice(("swing", "swing", "step"))].append(joint)
    kind = {"swing": "joint_trajectory_controller", "step": "joint_group_position_controller"}
    controllers = [
        f"  {name}: {{type: {kind[name]}, joints: [{', '.join(of)}]}}" for name, of in groups.items()
    ]
    for name, of in groups.items():
        if name == "swing":
            formulas = (
                f"{joint}: {{position: {random.uniform(-0.6, 0.6):.3f} * sin({random.randint(1, 5)} * t)}}"
                for joint in of
            )
            moves.append(
                f"  - {{controller: swing, duration: 2 s, samples: 40, joints: {{{', '.join(formulas)}}}}}"
            )
        else:
            goals = [
                (f"{joint}: {{position: {random.uniform(-1.5, 1.5):.3f} rad}}" for joint in of)
                for _ in range(4)
            ]
            points = (
                f"{{time: {n * 300} ms, joints: {{{', '.join(goal)}}}}}" for n, goal in enumerate(goals)
            )
            moves.append(f"  - {{controller: step, points: [{', '.join(points)}]}}")
    policies = (
        f"{{on_lost_servo: {random.choice(('hold', 'limp'))}, on_exit: {random.choice(('limp', 'hold'))}}}"
    )
    rate = 10 if "57600" in str(buses) else random.choice((20, 50, 100) if len(joints) < 5 else (20, 50))
    os.chdir(directory)
    robot, motion = Path("robot.yaml"), Path("motion.yaml")
    lines = ["name: made", "buses:", *buses, f"loop: {{rate: {rate}}}", "joints:", *joints]
    lines += ["controllers:", "  joint_state_broadcaster: {type: joint_state_broadcaster}", *controllers]
    robot.write_text("\n".join([*lines, f"policies: {policies}"]))
    motion.write_text("\n".join(["name: move", "motions:", *moves]))
    return robot, {}, [motion]


def faults(random: Random, robot: Any) -> Iterator[str]:
    """Yield faults that can happen to the robot, as a person would type them."""
    for _ in range(random.choice((0, 1, 1, 2))):
        kinds = ",".join(random.sample(KINDS, random.randint(1, 4)))
        at, within = random.choice((0, 500, 1000, 1500)), random.choice((100, 500, 1500))
        storm = f"storm seed={random.randint(0, 999)} faults={random.randint(1, 6)}"
        yield f"{storm} within={within}ms kinds={kinds} at={at}ms"
    for _ in range(random.choice((0, 0, 1, 3))):
        bus = random.choice(robot.buses)
        servo = random.choice([one.servo_id for one in bus.servos])
        text = random.choice(
            (
                "lose servo={}",
                "corrupt servo={} byte=4 count=3",
                "truncate servo={} keep=5",
                "delay servo={} by=3ms",
            )
        )
        host = random.choice(("", "", "lose from=host", "corrupt from=host byte=2 flip=0x81"))
        yield f"{host or text.format(servo)} bus={bus.name} packet={random.randint(1, 300)}"


def commands(random: Random, joints: list[str], controllers: list[str]) -> Iterator[tuple[int, str, bytes]]:
    """Yield time, kind and data of what a client asks the loop."""
    for _ in range(random.choice((0, 0, 1, 2, 4))):
        some = random.sample(joints, min(len(joints), random.randint(1, 3)))
        kind, data = random.choice((
            ("torque", {"joints": some, "on": random.random() < 0.5, "release": random.random() < 0.7}),
            ("reboot", {"joints": some[:1], "release": True}),
            ("switch", {"activate": [], "deactivate": [random.choice(controllers)]}),
            ("switch", {"activate": [random.choice(controllers)], "deactivate": []}),
            ("get", {"joint": some[0], "item": "present_temperature"}),
            ("register", {"joint": some[0], "item": "led", "value": 1}),
            ("rate", {"rate": random.choice((20.0, 25.0))}),
            ("pause", None), ("resume", None), ("halt", None),
        ))  # fmt: skip
        yield random.randint(10, 2500) * 1_000_000, kind, b"" if data is None else json.dumps(data).encode()


def topics(log: Path) -> dict[str, str]:
    """Return a hash of all messages of each topic; of packets with one message for each cycle."""
    from mcap.reader import make_reader

    found: dict[str, Any] = defaultdict(hashlib.sha256)
    with log.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            if schema and b"cycle_delta" in schema.data:
                continue
            name = schema.name if schema else ""
            found[f"topic {channel.topic}"].update(
                f"{name} {message.log_time} {len(message.data)} ".encode() + message.data
            )
    for topic, log_time, data in packets(log):
        found[topic].update(f"dxlrun_msgs/msg/BusPackets {log_time} {len(data)} ".encode() + data)
    return {topic: value.hexdigest()[:16] for topic, value in found.items()}


def packets(log: Path) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, time and message of each cycle's packets."""
    import numpy as np

    from dxlrun.log.log_reader import read_log
    from dxlrun.messages.cdr import Codec
    from dxlrun.messages.definition import MessageType

    arrays = "int64[] first_ns\nint64[] duration_ns\nuint8[] kind\nuint8[] servo_id\nuint16[] length\n"
    codec = Codec(MessageType("dxlrun_msgs/msg/BusPackets", f"int64 cycle\n{arrays}uint8[] data\n"))
    read = read_log(log)
    for index, bus in enumerate(read.buses):
        of_bus = read.packets.select_rows(read.packets.bus == index)
        begins = [0, *(np.flatnonzero(np.diff(of_bus.cycle)) + 1).tolist(), len(of_bus)]
        pieces = [at for begin, end in pairwise(begins) for at in range(begin, end, 1000)]
        for rows in np.split(np.arange(len(of_bus)), pieces[1:]):
            one = of_bus.select_rows(rows).compact()
            if len(one):
                took = one.last_ns - one.first_ns
                bodies = one.kind.tobytes(), one.servo_id.tobytes(), one.length.astype(np.uint16)
                data = codec.pack(int(one.cycle[0]), one.first_ns, took, *bodies, one.data.tobytes())
                yield f"topic /bus/{bus}", int(one.last_ns[-1]) + read.header.epoch_offset_ns, data


def run(number: int, tree: Path, directory: Path, show: Path | None) -> dict[str, Any]:
    """Run one and return its hashes."""
    from dxlrun.testing import simulated_robot
    from dxlsim.faults.fault import parse_fault
    from dxlsim.faults.script import FaultScript

    random = Random(f"same {number}")
    robot_file, arguments, motions = (shipped if number % 2 else made)(random, tree, directory)
    log = directory / "run.mcap" if (number % 4 < 2 and number % 8 < 4) or number % 16 == 7 else None
    random.random()  # earlier trees chose the parser by it
    duration_s = random.choice((0.5, 1.0, 1.5, 2.0))
    robot = simulated_robot(robot_file, arguments=arguments, play=motions, duration_s=duration_s, log=log)
    script = FaultScript([parse_fault(text) for text in faults(random, robot)], seed=number)
    script.attach(robot.buses)
    loop = robot.plan.loop
    joints, controllers = [one.name for one in loop.joints], [one.name for one in loop.controllers]
    module = vars(sys.modules[type(robot.inbox).__module__])
    made_of = module.get("CommandMessage") or module["Command"]  # its name in older trees
    for index, (at_ns, kind, data) in enumerate(commands(random, joints, controllers), 1):
        command = made_of(index, "", kind, data, "same")
        robot.clock.call_at(at_ns, lambda command=command: robot.inbox.waiting.append(command))
    end = "raised"
    try:
        result = robot.run()
        end = f"{result.reason} {result.cycles} {result.skipped} {result.last}"
    except Exception as error:  # a robot that does not start is a result too
        found = {"error": f"{type(error).__name__}: {error}"}
    else:
        found = {"error": f"{result.detail} {robot.failures}"}
    wire, notes = hashlib.sha256(), hashlib.sha256()
    for entry in robot.ledger.entries:
        (notes if entry.direction == "note" else wire).update(repr(tuple(entry)).encode())
    if show:
        show.write_text(
            "\n".join(f"{e.t_ns} {e.bus} {e.direction} {e.data.hex()} {e.note}" for e in robot.ledger.entries)
        )
    found |= {
        "robot": robot_file.stem,
        "faults": sum(e.note.startswith("fault") for e in robot.ledger.entries),
    }
    found |= {
        "end": end,
        "wire": f"{len(robot.ledger.entries)} {wire.hexdigest()[:16]}",
        "notes": notes.hexdigest()[:16],
    }
    return found | (topics(log) if log and log.exists() else {})


def run_all(tree: Path, out: Path, numbers: list[int]) -> None:
    """Run them all, and write the file."""
    results = {}
    for number in numbers or range(RUNS):
        with tempfile.TemporaryDirectory() as directory:
            show = out.with_suffix(f".{number}.txt") if numbers else None
            try:
                results[str(number)] = run(number, tree, Path(directory), show)
            except Exception as error:
                results[str(number)] = {"error": f"{type(error).__name__}: {error}"}
                traceback.print_exc() if numbers else None
    out.write_text(json.dumps(results, indent=1))
    print(
        f"{len(results)} runs; ends: "
        f"{Counter(one.get('end', 'not run').split()[0] for one in results.values())}"
    )
    print(f"recorded: {sum(any(key.startswith('topic') for key in one) for one in results.values())}; "
          f"with faults: {sum(one.get('faults', 0) > 0 for one in results.values())}")  # fmt: skip


def compare(before: Path, after: Path) -> int:
    """Print what differs; return 1 if that is more than words."""
    old, new = json.loads(before.read_text()), json.loads(after.read_text())
    differing: dict[str, list[str]] = defaultdict(list)
    for number in new:
        for key in old[number].keys() | new[number].keys():
            if old[number].get(key) != new[number].get(key):
                differing[key].append(number)
    left = {key for key in differing if not any(key in one for one in new.values())}
    for key, numbers in sorted(differing.items()):
        word = " (words)" if key in WORDS else " (left)" if key in left else ""
        print(f"{key}{word}: {len(numbers)} of {len(new)} runs differ: {' '.join(numbers)}")
    print(f"{len(new)} runs compared: {'all equal' if not differing else 'see above'}")
    return int(bool(differing.keys() - {*WORDS, *left}))


if __name__ == "__main__":
    first, second, *rest = sys.argv[1:]
    if first.endswith(".json"):
        raise SystemExit(compare(Path(first), Path(second)))
    python = Path(first).resolve() / ".venv/bin/python"
    if Path(sys.prefix) != python.parents[1]:
        os.execv(python, [str(python), *sys.argv])  # noqa: S606  the same program, in the tree that is measured
    run_all(Path(first).resolve(), Path(second).resolve(), [int(one) for one in rest])
