"""Commands of a shell to an arm that runs, on virtual time: those of the page, and the refused ones of
`refusals.txt`, each with the text of the command.
"""

import shlex
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from tests.kit.cases import TextCase, case_parameters
from tests.kit.commands import Dxlrun
from tests.kit.judged_arms import arms
from tests.kit.pages import page_commands

from dxlrun import RemoteRobot
from dxlrun.cli.steering import goals
from dxlrun.testing import plan_of
from dxlrun.tooling.runs import VirtualLink

ROBOTS = Path(__file__).parents[2] / "robots"


def test_commands_of_the_page(dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch) -> None:
    link = VirtualLink(plan_of(ROBOTS / "open_manipulator_x_space.yaml"))
    robot, arm = RemoteRobot("arm", link), arms()["open_manipulator_x"]
    monkeypatch.setattr(goals, "connect_robot", lambda *_: nullcontext(robot))
    robot.send("arm", "pose", {"x": 0.15, "y": 0.0, "z": 0.2, "path": "joints"})
    for _ in range(400):
        link.run_cycle()
    tips = []
    commands = [words for words in page_commands("standard-controllers.md") if "pose" in words]
    assert len(commands) == 2
    for words in commands:
        said = dxlrun(*words)
        assert (said.code, said.err) == (0, "")
        for _ in range(300):
            link.run_cycle()
        measured = dict(zip(robot.states().joints, robot.states().position.tolist(), strict=True))
        tips.append(arm.matrix([measured[joint] for joint in arm.joints])[:3, 3])
    assert tips[0] == pytest.approx([0.2, 0.0, 0.15], abs=1e-3)  # within the ticks of servos
    assert tips[1] - tips[0] == pytest.approx([0.0, 0.0, 0.05], abs=1e-3)
    assert dxlrun("send", "arm", "plan", "above").code == 0
    assert {state.status for state in robot.goals()} == {"reached"}


@pytest.fixture(scope="module")
def link() -> VirtualLink:
    found = VirtualLink(plan_of(ROBOTS / "open_manipulator_x_space.yaml"))
    RemoteRobot("arm", found).send("arm", "pose", {"x": 0.15, "y": 0.0, "z": 0.2, "path": "joints"})
    for _ in range(300):
        found.run_cycle()
    return found


@pytest.mark.parametrize("case", case_parameters(Path(__file__).parent / "refusals.txt"))
def test_bad_input_is_refused_with_the_reason_before_a_joint_moves(
    case: TextCase, link: VirtualLink, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = RemoteRobot("arm", link)
    monkeypatch.setattr(goals, "connect_robot", lambda *_: nullcontext(robot))
    before = robot.states().position.copy()
    link.new()
    said = dxlrun("send", "arm", *shlex.split(case.name))
    for _ in range(20):
        link.run_cycle()
    assert said.code == 2
    assert case.lines[0].text in said.err
    assert np.array_equal(robot.states().position, before)


def test_a_joint_lost_before_the_motion_is_not_a_mistake_of_the_command(
    dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = VirtualLink(plan_of(ROBOTS / "open_manipulator_x_space.yaml"))
    monkeypatch.setattr(goals, "connect_robot", lambda *_: nullcontext(RemoteRobot("arm", link)))
    link.simulated.buses[0].servo(12).silence()
    for _ in range(100):
        link.run_cycle()
    said = dxlrun("send", "arm", "pose", "dz=1cm", "--wait")
    assert said.code == 1
    assert "joint2 (ID 12 on bus main) does not answer" in said.err


def test_the_measured_tip_stays_on_a_line_of_20_cm() -> None:
    """Servos lag behind along the line, and leave it by their ticks."""
    link = VirtualLink(plan_of(ROBOTS / "open_manipulator_x_space.yaml"))
    robot, arm, tips = RemoteRobot("arm", link), arms()["open_manipulator_x"], []
    robot.send("arm", "pose", {"x": 0.2, "y": -0.1, "z": 0.15, "path": "joints"})
    for _ in range(500):
        link.run_cycle()
    link.new()
    done = robot.send("arm", "pose", {"dy": 0.2})
    assert done.goal is not None
    for _ in range(300):
        link.run_cycle()
    cycles, _ = link.new()
    for row in cycles["position"]:
        tips.append(arm.matrix(row[: len(arm.joints)])[:3, 3])
    off = np.array(tips) - tips[0]
    assert np.abs(off[:, [0, 2]]).max() < 2e-3
    assert off[-1] == pytest.approx([0.0, 0.2, 0.0], abs=3e-3)  # at rest a servo is up to 0.4 deg off
    assert robot.goal_state(done.goal.number).status == "reached"
