"""A simulated torso with an IMU in a process of its own, and what its servos were sent."""

import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tests.kit.awaited import DEADLINE_S, until
from tests.kit.wire import all_writes, commands, taken_apart

from dxlrun import running
from dxlsim.bus.ledger import read_ledger

ROBOTS = Path(__file__).resolve().parents[2] / "robots"
JOINT, SERVO = "right_elbow_joint", 4
SERVOS = (1, 2, 3, 4, 5, 6, 20, 21)
TORSO: Any = SimpleNamespace(protocol=1.0, servos=[SimpleNamespace(servo_id=servo) for servo in SERVOS])
TORQUE_ENABLE, GOAL_POSITION = 24, 30


def copy_robots(place: Path) -> None:
    """Copy the folder of robot files; of two a reply may be late, as on a busy machine."""
    shutil.copytree(ROBOTS, place / "robots")
    for name in ("bioloid_torso", "open_manipulator_x"):
        robot = place / f"robots/{name}.yaml"
        robot.write_text(robot.read_text().replace("latency: 1 ms", "latency: 20 ms"))


def settled(ledger: Path, cycles: Callable[[], int], quiet: int) -> set[tuple[int, int, bytes]]:
    """Wait until nothing new was written to servos for so many cycles; return what was written."""
    found, since = written(ledger), cycles()
    while cycles() < since + quiet:
        time.sleep(0.1)
        if (now := written(ledger)) != found:
            found, since = now, cycles()
    return found


def written(ledger: Path) -> set[tuple[int, int, bytes]]:
    """Return servo, address and bytes of all that was written to servos of Protocol 1.0, each once."""
    return commands([*taken_apart(read_ledger(ledger), 1.0)], 1.0)


class Run:
    """A robot in a process of its own, by default the torso."""

    def __init__(
        self,
        place: Path,
        *words: str,
        record: bool = False,
        robot: str = "bioloid_torso_imu",
        rate: int = 5,
    ) -> None:
        """`words`: more words of its command line."""
        self.place, self.record, self.words = place, record, words
        self.robot, self.rate = robot, rate
        self.ledger = place / "ledger.jsonl"
        self.process: subprocess.Popen[bytes] | None = None
        copy_robots(place)

    def start(self) -> None:
        code = "from dxlrun.cli import main; main()"
        words = [
            f"robots/{self.robot}.yaml",
            f"rate:={self.rate}",
            *(() if self.record else ("--no-record",)),
            "--ledger",
            str(self.ledger),
            *(self.words or ("--duration", "3600")),
        ]
        with (self.place / "said").open("wb") as said:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-c", code, *words], cwd=self.place, stdout=said, stderr=said
            )
        until(lambda: bool(running()) or self.process is None or self.process.poll() is not None)
        assert self.process.poll() is None, (self.place / "said").read_text()

    def end(self) -> None:
        if self.process is not None:
            self.process.terminate()
            self.process.wait(DEADLINE_S)
            self.process = None
            self.ledger.unlink()

    @property
    def limp(self) -> bool:
        """True when no servo has torque."""
        written = self.written(TORQUE_ENABLE)
        return all(written[servo] == 0 for servo in SERVOS)

    def written(self, address: int) -> dict[int, int]:
        """Return what was last written at an address of each servo (Protocol 1.0)."""
        width = 2 if address == GOAL_POSITION else 1
        return {
            servo: int.from_bytes(data[address - begin :][:width], "little")
            for _, servo, begin, data in all_writes(read_ledger(self.ledger), TORSO)
            if begin <= address < begin + len(data)
        }
