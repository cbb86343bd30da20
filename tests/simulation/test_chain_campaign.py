"""Campaign: storms of faults on a robot with a chain of controllers, steered meanwhile, on virtual time.

A trajectory commands a PID on positions, which commands two of the three joints of a PID on efforts;
another controller commands the third. Clients send goals, cancel, switch, and request torque and reboots, and
controllers fail.
Judged by the simulated bus' ledger and the log, see tests/kit/storms.py. CI runs 3 storms of 3 s. The full
campaign, of 5 s each:

    pytest --campaign=release tests/simulation/test_chain_campaign.py
"""

import json
import random
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tests.kit import storms
from tests.kit.campaigns import campaign
from tests.kit.judges import log_has_every_byte

from dxlrun.channels.answers import Acceptance
from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.event_records import EventCode
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.log.log_reader import Log, read_log
from dxlrun.testing import VirtualRobot, simulated_robot
from dxlsim.faults.kinds import KINDS
from dxlwire.bus_plan import BusPlan

MS = 1_000_000
SYNC_WRITE = 0x83
LIMITS = "limits: {position: [-1.2 rad, 1.2 rad], velocity: 4 rad/s, effort: 1 A}"
REACH = 1.2
JOINTS = ("shoulder", "elbow", "wrist", "hand")
HEAD = """\
name: chained
loop: {rate: 50}
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 100 us}
joints:
"""
CONTROLLERS = """\
controllers:
  pid: {type: pid_controller, joints: [shoulder, elbow, wrist], command_interface: effort,
        gains: {p: 2.0, i: 0.5, d: 0.1}, fallback: standby}
  smooth: {type: pid_controller, joints: [shoulder, elbow], command_interface: position, gains: {p: 0.2},
           into: pid}
  arm: {type: joint_trajectory_controller, joints: [shoulder, elbow], into: smooth}
  turn: {type: joint_group_position_controller, joints: [wrist], into: [pid]}
  grip: {type: joint_group_position_controller, joints: [hand], fallback: relax}
  relax: {type: joint_group_position_controller, joints: [hand], active: false}
  standby: {type: joint_group_position_controller, joints: [shoulder, elbow, wrist], active: false}
"""
NAMES = ("pid", "smooth", "arm", "turn", "grip", "relax", "standby")
INTO = {"smooth": "pid", "arm": "smooth", "turn": "pid"}
COMMANDS_SERVOS = {"pid": (0, 1, 2), "standby": (0, 1, 2), "grip": (3,), "relax": (3,)}
POLICIES = (
    "",
    "policies: {on_lost_servo: hold, on_returned_servo: hold}\n",
    "policies: {on_returned_servo: hold, on_fault: limp}\n",
)
LASTING = ",".join(name for name in KINDS if name not in {"storm", "tip", "unplug"})
FORBIDDEN = 200 * MS
"""What idle time had begun for a servo when a request came has ended by then."""


def draw_storm(chance: random.Random, duration_s: float) -> str:
    seed, faults = chance.randrange(10**6), chance.randint(1, 8)
    kinds = chance.choice(("", f" kinds={LASTING}", " kinds=reboot,lose,silence,overload"))
    return f"storm seed={seed} faults={faults} within={round((duration_s - 1) * 1000)}ms{kinds} at=300ms"


def built(directory: Path, chance: random.Random, duration_s: float) -> VirtualRobot:
    keys = "bus: main, model: XM430-W350, reference: 180 deg"
    joints = "".join(
        f"  {name}: {{{keys}, id: {number}, direction: {1 if number % 2 else -1}, {LIMITS}}}\n"
        for number, name in enumerate(JOINTS, 1)
    )
    path = directory / "chained.yaml"
    path.write_text(HEAD + joints + CONTROLLERS + chance.choice(POLICIES))
    return simulated_robot(path, duration_s=duration_s, log=directory / "run.mcap")


SWITCHES = (
    (["arm"], []), (["turn"], []), (["arm", "turn"], []), (["arm", "turn"], ["standby"]),
    (["standby"], ["arm", "smooth", "turn", "pid"]), (["standby"], []), ([], ["arm"]), ([], ["smooth"]),
    (["grip"], []), (["relax"], ["grip"]), (["grip"], ["relax"]), (["pid"], []),
)  # fmt: skip
STREAMS = (("turn", 1), ("grip", 1), ("relax", 1), ("standby", 3))


class Clients:
    """Requests of every kind at random times, and controllers that fail."""

    def __init__(self, robot: VirtualRobot, chance: random.Random, duration_s: float) -> None:
        self.robot, self.chance = robot, chance
        self.end_ms = round(duration_s * 1000)
        requests = (self.goal, self.torque, self.switch) * 2 + (
            self.reboot,
            self.cancel,
            self.stream,
            self.halt,
        )
        for number in range(1, 1 + chance.choice((5, 20, round(10 * duration_s)))):
            command = CommandMessage(number, *chance.choice(requests)(), "anna")
            self.at(300, lambda command=command: robot.inbox.waiting.append(command))
        for _ in range(chance.choice((0, 0, 1, 2))):
            self.fail(chance.choice(("pid", "smooth", "arm", "turn", "grip", "standby")))

    def at(self, begin_ms: int, act: Callable[[], object]) -> None:
        self.robot.buses[0].at(self.chance.randrange(begin_ms, self.end_ms) * MS, act)

    def request(self, kind: str, **data: object) -> tuple[str, str, bytes]:
        return "", kind, json.dumps(data).encode()

    def goal(self) -> tuple[str, str, bytes]:
        offered = load_plugins().controllers["joint_trajectory_controller"].controller
        parameters = offered.Parameters.model_validate({"joints": ("shoulder", "elbow")})
        end = [self.chance.uniform(-1, 1) for _ in range(2)]
        points = {"points": [{"time": self.chance.choice((0.3, 1.0)), "positions": end}]}
        command = offered.Commands["trajectory"].model_validate(points)
        return "arm", "trajectory", np.asarray(offered.prepare("trajectory", command, parameters)).tobytes()

    def stream(self) -> tuple[str, str, bytes]:
        name, count = self.chance.choice(STREAMS)
        return name, "positions", np.array([self.chance.uniform(-1, 1) for _ in range(count)]).tobytes()

    def torque(self) -> tuple[str, str, bytes]:
        joints, release = (
            self.chance.sample(JOINTS, self.chance.choice((1, 2, 4))),
            self.chance.random() < 0.6,
        )
        return self.request("torque", joints=joints, on=self.chance.random() < 0.6, release=release)

    def reboot(self) -> tuple[str, str, bytes]:
        joints = self.chance.sample(JOINTS, self.chance.choice((1, 2)))
        return self.request("reboot", joints=joints, release=self.chance.random() < 0.7)

    def switch(self) -> tuple[str, str, bytes]:
        activate, deactivate = self.chance.choice(SWITCHES)
        return self.request("switch", activate=activate, deactivate=deactivate)

    def cancel(self) -> tuple[str, str, bytes]:
        return self.request("cancel", controller="arm")

    def halt(self) -> tuple[str, str, bytes]:
        return "", "halt", b""

    def fail(self, name: str) -> None:
        def breaks(*_: object) -> None:
            raise RuntimeError("a fault of the storm")

        self.at(400, lambda: setattr(self.robot.robot.loop.manager._named[name].controller, "update", breaks))


def active_in(log: Log) -> list[set[str]]:
    return [{name for bit, name in enumerate(NAMES) if int(mask) >> bit & 1} for mask in log.cycles["active"]]


def chains_are_whole(log: Log) -> None:
    """No upper one without its lower one, and no joint with two commanders, in any cycle."""
    for cycle, active in enumerate(active_in(log)):
        assert not [name for name in active if name in INTO and INTO[name] not in active], (cycle, active)
        rows = [row for name in active for row in COMMANDS_SERVOS.get(name, ())]
        assert len(rows) == len(set(rows)), (cycle, active)


def those_above_leave_with_what_failed(log: Log) -> None:
    """In the cycle of a fault the whole chain above is out, and the fallback in, or the run ends."""
    for event in log.events:
        if event.code != EventCode.CONTROLLER_FAULT:
            continue
        after = int(np.searchsorted(log.cycles["woken_ns"], event.t_ns, side="right")) - 1
        if not 0 <= after < len(log.cycles) - 1:
            continue
        active = active_in(log)[after]
        above = {event.source}
        for name in ("smooth", "arm", "turn"):
            if INTO[name] in above:
                above.add(name)
        assert not above & active, (event.source, active)


def servos_get_the_goals_of_one_commander(sent: Sequence[Any], bus: BusPlan, log: Log) -> None:
    """By the wire: a servo gets one goal a cycle; a current only of the PID, a position only without it."""
    woken, done = log.cycles["updated_ns"], log.cycles["written_ns"]
    active = active_in(log)
    seen: set[tuple[int, int, str]] = set()
    count = 0
    cyclic = [one for one in sent if one.instruction == SYNC_WRITE]  # those of idle time are for one servo
    for item in ("goal_position", "goal_current"):
        for t_ns, servo, raw in storms.written(cyclic, bus, item):
            cycle = int(np.searchsorted(woken, t_ns, side="right")) - 1
            if cycle < 0 or t_ns > done[cycle]:
                continue  # of the start
            count += 1
            assert (cycle, servo.servo_id, item) not in seen
            seen.add((cycle, servo.servo_id, item))
            leads = "pid" in active[cycle] and servo.row < 3
            if item == "goal_current":
                assert leads or raw == 0, (cycle, servo.joint, raw)
            else:
                assert not leads, (cycle, servo.joint)
            limp = log.cycles["torque"][cycle][servo.row] in {3, 4, 5, 6}
            assert not limp, (cycle, servo.joint)
    assert count or len(log.cycles) < 100


def joints_begin_softly(sent: Sequence[Any], witness: Any, bus: BusPlan, log: Log) -> None:
    """Whenever torque comes on, the goal is where the servo stands; a current is none."""
    by_id = {servo.servo_id: servo for servo in bus.servos}
    goals = {
        item: list(storms.written(sent, bus, item))
        for item in ("goal_position", "goal_current", "operating_mode")
    }

    def last(item: str, servo: Any, t_ns: int) -> int | None:
        values = [raw for at, one, raw in goals[item] if one is servo and at <= t_ns]
        return values[-1] if values else None

    for t_ns, servo_id, shaft_rad in witness.found:
        servo = by_id[servo_id]
        mode = last("operating_mode", servo, t_ns)
        if mode == 0:
            assert last("goal_current", servo, t_ns) == 0, (t_ns, servo.joint)
            continue
        goal = last("goal_position", servo, t_ns)
        if goal is not None:
            where = storms.angle(servo, goal)
            stands = servo.direction * (shaft_rad - servo.reference)
            stands = min(max(stands, -REACH), REACH)  # one that left its limits goes back to them
            assert abs(where - stands) < storms.BUMP, (t_ns, servo.joint, where, stands)


def nothing_for_released_joints(sent: Sequence[Any], bus: BusPlan, log: Log) -> None:
    """From torque off to the next torque on: no goal of any kind and no torque; no current is not a goal."""
    requests = storms.torque_requests(log)
    wire = [
        (t_ns, servo.joint, item)
        for item in ("goal_position", "goal_current", "torque_enable")
        for t_ns, servo, raw in storms.written(sent, bus, item)
        if item == "goal_position" or raw
    ]
    for number, one in enumerate(requests):
        if one.off:
            later = [two.t_ns for two in requests[number + 1 :] if two.joint == one.joint and not two.off]
            until, after = min(later, default=1 << 62), one.t_ns + FORBIDDEN
            found = [each for each in wire if each[1] == one.joint and after < each[0] < until]
            assert not found, (one, found)


@campaign(ci=3, night=25, release=100)
def test_a_storm_breaks_no_chain(number, amount, chance, tmp_path):
    duration_s = min(5.0, amount)
    storm = draw_storm(chance, duration_s)
    print(f"{number}: {storm}")
    robot = built(tmp_path, chance, duration_s)
    Clients(robot, chance, duration_s)
    trial = storms.Trial.of(robot, [storm])
    assert trial.run()
    log = read_log(tmp_path / "run.mcap")
    entries, (bus,) = robot.ledger.entries, robot.plan.buses
    sent, (witness,) = list(storms.instructions(entries, bus)), trial.witnesses
    halted_ns = [event.t_ns for event in log.events if event.text.startswith("halt ")]
    storms.goals_are_within_limits(sent, bus, robot, halted_ns)
    storms.samples_are_what_was_sent(list(storms.states(entries, bus)), witness, bus, log)
    log_has_every_byte(log, entries)
    storms.everybody_who_hears_is_limp(robot, 0, robot.failures)
    storms.faults_and_events_answer_each_other(entries, log)
    chains_are_whole(log)
    those_above_leave_with_what_failed(log)
    servos_get_the_goals_of_one_commander(sent, bus, log)
    nothing_for_released_joints(sent, bus, log)
    joints_begin_softly(sent, witness, bus, log)
    assert not any(isinstance(answer, Acceptance) for answer in robot.inbox.answers.values())
    assert not any("Traceback" in event.text and "storm" not in event.text for event in log.events)
