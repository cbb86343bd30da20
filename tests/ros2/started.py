"""Robots, their bridges and foreign ROS programs, each a process; what simulated servos were sent."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tests.kit import wire
from tests.kit.awaited import DEADLINE_S, until

import dxlrun
from dxlrun.testing import plan_of
from dxlsim.bus.ledger import LedgerEntry

ROBOTS = Path(__file__).parents[2] / "robots"
PYTHON = os.getenv("DXLRUN_ROS2_PYTHON", "")
"""Of a ROS environment that has dxlrun_ros2"""
READS = {wire.READ, wire.SYNC_READ, wire.FAST_SYNC_READ}
STILL = 40
"""So many reads after the last new goal, joints hold: a second of the torso at `RATE`."""
RATE = 5
"""Hz: on a busy machine a loop may stand still for almost five periods, and replies are late"""


def seconds(number: float) -> dict[str, int]:
    """Return a duration as ROS has it."""
    return dict(zip(("sec", "nanosec"), divmod(round(number * 1e9), 10**9), strict=True))


def stamp_ns(message: Mapping[str, Any]) -> int:
    return int(message["header"]["stamp"]["sec"] * 10**9 + message["header"]["stamp"]["nanosec"])


class Goal(NamedTuple):
    """A goal position that a servo was sent."""

    t_ns: int
    joint: str
    position: float
    """rad"""


class Robot:
    """A robot in a process of its own."""

    def __init__(self, place: Path, file: Path, rate: float, environment: Mapping[str, str]) -> None:
        self.name = name = file.stem
        earlier = len([*place.glob(f"{name}*.ledger")])  # of this robot, before it was started anew
        self.ledger = place / f"{name}_{earlier}.ledger"
        self.place, self.bus = place, plan_of(file).buses[0]
        self._read, self._sent = 0, list[wire.Instruction]()
        program = Path(sys.executable).with_name("dxlrun")
        command = [program, file, f"rate:={rate}", "--ledger", self.ledger, "--duration", "7200"]
        with (place / f"{name}.said").open("ab") as said:
            self.process = subprocess.Popen(command, cwd=place, stdout=said, stderr=said, env=environment)
        until(lambda: name in dxlrun.running() or self.process.poll() is not None, name)
        assert self.process.poll() is None, (place / f"{name}.said").read_text()

    @property
    def log(self) -> Path:
        return max(self.place.glob(f"logs/{self.name}_*.mcap"), key=lambda path: path.stat().st_mtime_ns)

    def sent(self, since: int = 0) -> list[wire.Instruction]:
        """Return the instructions that the ledger has, from number `since` on; each line is read once."""
        with self.ledger.open("rb") as stream:
            stream.seek(self._read)
            lines, newline, _ = stream.read().rpartition(b"\n")
        self._read += len(lines) + len(newline)
        for line in lines.splitlines():
            one = json.loads(line)
            if one["direction"] == "in":
                entry = LedgerEntry(one["t_ns"], one["bus"], "in", bytes.fromhex(one["bytes"]), "")
                self._sent += wire.instructions([entry], self.bus)
        return self._sent[since:]

    def goals(self, since: int = 0) -> list[Goal]:
        """Return the goal positions from instruction `since` on."""
        return self._goals_in(self.sent(since))

    def _goals_in(self, sent: Sequence[wire.Instruction]) -> list[Goal]:
        found = wire.written(sent, self.bus, "goal_position")
        return [Goal(at, servo.joint, wire.angle(servo, raw)) for at, servo, raw in found]

    def moved(self, since: int) -> dict[str, set[float]]:
        """Return the goals of each joint that was sent two that differ."""
        found: dict[str, set[float]] = {}
        for _, joint, position in self.goals(since):
            found.setdefault(joint, set()).add(position)
        return {joint: positions for joint, positions in found.items() if len(positions) > 1}

    def held(self, since: int) -> dict[str, list[float]]:
        """Return each joint's goals from its last one before `since` on, when all have stayed for some reads.

        A goal that stays is sent again every ten seconds, so a joint may have been sent none since.
        """
        before = {one.joint: one for one in self._goals_in(self.sent()[:since])}

        def ended() -> list[Goal] | None:
            goals = [*before.values(), *self.goals(since)]
            last: dict[str, float] = {}
            changed_ns = 0
            for at, joint, position in goals:
                changed_ns = at if last.get(joint) != position else changed_ns
                last[joint] = position
            reads = sum(one.t_ns > changed_ns and one.instruction in READS for one in self.sent(since))
            return goals if goals and reads >= STILL else None

        found: dict[str, list[float]] = {}
        for _, joint, position in until(ended, "joints that hold"):
            found.setdefault(joint, []).append(position)
        return found

    def torque(self) -> dict[str, int]:
        """Return what each joint was last sent as its torque enable."""
        return {one.joint: raw for _, one, raw in wire.written(self.sent(), self.bus, "torque_enable")}

    def mark(self) -> int:
        """Return how many instructions the ledger has."""
        return len(self.sent())

    def end(self) -> None:
        self.process.send_signal(signal.SIGINT)
        self.process.wait(DEADLINE_S)


class Foreign:
    """A foreign ROS program that runs; its verbs are those of foreign.py."""

    def __init__(self, name: str, environment: Mapping[str, str]) -> None:
        self.process = subprocess.Popen(
            [PYTHON, Path(__file__).with_name("foreign.py"), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )

    def ask(self, verb: str, *words: Any) -> None:
        """Say a line, without waiting for its answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps([verb, *words]) + "\n")
        self.process.stdin.flush()

    def answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the foreign program ended"
        kind, answer = json.loads(line)
        assert kind == "ok", answer
        return answer

    def do(self, verb: str, *words: Any) -> Any:
        """Say a line and return its answer."""
        self.ask(verb, *words)
        return self.answer()

    def end(self, how: signal.Signals | None = None) -> None:
        if how is not None:
            self.process.send_signal(how)
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(DEADLINE_S)
        self.process.stdout.close()


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of ROS programs and robots, whose files and sockets are in a folder."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "COV_"))}
    return kept | {
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",  # what is killed leaves no shared memory behind
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_LOG_DIR": str(folder / "ros"),
        "XDG_RUNTIME_DIR": str(folder),
    }


class Place:
    """A folder and a ROS domain, in which robots, bridges and foreign programs run; `end` ends them all."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        shutil.copytree(ROBOTS, folder / "robots")
        self.environment = environment(folder)
        self._running: list[Robot | Foreign | subprocess.Popen[bytes]] = []

    def robot(self, name: str, rate: float = RATE) -> Robot:
        """Start a robot of `robots`, whose joint states are those of every cycle."""
        file = self.folder / f"robots/{name}.yaml"
        text = file.read_text().replace("joint_state_broadcaster, rate: 50", "joint_state_broadcaster")
        if rate == RATE:
            text = re.sub("adapter: {.*?}", "adapter: {latency: 100 ms}", text)
        file.write_text(text)
        self._running.append(robot := Robot(self.folder, file, rate, self.environment))
        return robot

    def foreign(self, name: str = "foreign") -> Foreign:
        self._running.append(foreign := Foreign(name, self.environment))
        return foreign

    def bridge(self, robot: str, *words: str) -> subprocess.Popen[bytes]:
        """Start `dxlrun-ros2` of the ROS environment."""
        with (self.folder / f"{robot}.bridge").open("ab") as said:
            process = subprocess.Popen(
                [Path(PYTHON).with_name("dxlrun-ros2"), robot, *words],
                cwd=self.folder,
                env=self.environment,
                stdout=said,
                stderr=said,
            )
        self._running.append(process)
        return process

    def said(self) -> str:
        """Return what bridges printed."""
        return "".join(path.read_text() for path in self.folder.glob("*.bridge"))

    def end(self) -> None:
        while self._running:
            one = self._running.pop()
            if isinstance(one, subprocess.Popen):
                one.terminate()
                one.wait(DEADLINE_S)
            elif one.process.poll() is None:
                one.end()
