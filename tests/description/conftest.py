# ruff: noqa: E501 (a mistake and its sentence are read best side by side)

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from dxlrun.description import MotionDescription, Survey, read_motion, survey_robot
from dxlrun.description.reading import Description, read_robot
from dxlrun.errors import InputError

ROBOT = """\
name: torso
arguments:
  port: {default: sim, help: "serial port of the adapter, or sim"}
  rate: {default: 50, help: "loop rate, Hz"}
buses:
  main: {port: "${port}", protocol: 1.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}, return_delay_time: 250 us}
loop:
  rate: ${rate}
  scheduler: {policy: round_robin, priority: 31, lock_memory: true}
joints:
  swing: {bus: main, id: 1, model: AX-12A, reference: 60 deg, direction: -1, limits: {position: [-180 deg, 60 deg]}}
  elbow: {bus: main, id: 5, model: AX-12A, reference: 150 deg, direction: 1}
controllers:
  broadcaster: {type: joint_state_broadcaster, rate: 25}
  arm: {type: joint_group_position_controller, joints: [swing, elbow], active: false}
policies: {on_exit: limp, exit_timeout: 3 s}
recording: {directory: elsewhere}
"""


class Desk:
    """A folder in which a test writes files and has them read; problems come back as text without the folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def write(self, text: str | bytes, name: str = "robot.yaml") -> Path:
        path = self.folder / name
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    def robot(self, text: str, arguments: Mapping[str, str] | None = None) -> Description:
        return read_robot(self.write(text), arguments or {})

    def survey(self, text: str, arguments: Mapping[str, str] | None = None) -> Survey:
        return survey_robot(self.write(text), arguments or {})

    def motion(self, text: str) -> MotionDescription:
        return read_motion(self.write(text, "motion.yaml"))

    def refusals(self, text: str | bytes, arguments: Mapping[str, str] | None = None) -> list[str]:
        path = self.write(text)
        return self.caught(lambda: read_robot(path, arguments or {}))

    def motion_refusals(self, text: str) -> list[str]:
        path = self.write(text, "motion.yaml")
        return self.caught(lambda: read_motion(path))

    def pointed(self, text: str, right: str, wrong: str) -> tuple[str, str]:
        """Return the text with `wrong` instead of `right`, and the line and column at which its § points."""
        assert right in text
        marked = text.replace(right, wrong, 1)
        before = marked[: marked.index("§")]
        place = f"{before.count(chr(10)) + 1}:{len(before) - before.rfind(chr(10))}"
        return marked.replace("§", ""), place

    def caught(self, read: Callable[[], object]) -> list[str]:
        with pytest.raises(InputError) as caught:
            read()
        return [str(problem).replace(f"{self.folder}/", "") for problem in caught.value.problems]


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path)


@pytest.fixture
def robot_text() -> str:
    return ROBOT
