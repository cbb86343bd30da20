"""`dxlrun identify` on the command line: on virtual time, of a log, and what it refuses."""

import re
from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.campaigns import campaign
from tests.kit.experiments import ROBOTS
from tests.kit.pages import page_commands

from dxlrun.description.joints.motor_file import read_motor

pytestmark = pytest.mark.long

ROBOT = ROBOTS / "single_joint.yaml"
OF_THE_PAGE = page_commands("experiments.md", "Identify")


@pytest.mark.parametrize(("number", "sentence"), [(1, "0.5 s are too short"), (2, "not found; a run prints")])
def test_the_other_commands_of_the_page(number, sentence, dxlrun, here):
    words = [word.replace("/dev/ttyUSB0", "sim") for word in OF_THE_PAGE[number]]
    said = dxlrun(*words, *(["--virtual", "--duration", "0.5"] if number == 1 else []))
    assert said.code == 2
    assert sentence in said.err


def test_a_virtual_robot_is_moved_and_its_motor_file_written(dxlrun, here):
    """The first command of the page, for 10 s."""
    motor, report = here / "joint.motor.yaml", here / "report.html"
    said = dxlrun(*OF_THE_PAGE[0], "--duration", 10, "--report", report)
    assert said.code == 0, said.err
    assert "joint (MX-64)" in said.out
    assert "* torques are scaled by the manual's stall torque, 6 Nm at 12 V" in said.out
    assert re.search(r"^ *inertia \*", said.out, re.MULTILINE)
    assert not re.search(r"^ *delay \*", said.out, re.MULTILINE)
    assert "slow triangles" in said.err
    (log,) = Path("logs").glob("*.mcap")
    assert f"log: {log}\n" in said.out
    assert read_motor(motor).motor.torque_constant == pytest.approx(1.6315, rel=0.03)
    assert "fit and residual" in report.read_text()
    text = motor.read_text()
    again = dxlrun("identify", ROBOT, "joint", "--virtual", "--output", motor)
    assert again.code == 2
    assert "cannot be written (it exists)" in again.err
    assert motor.read_text() == text


@campaign(ci=0, night=1, release=1)
def test_a_log_as_json(xl330, dxlrun):
    said = dxlrun("identify", "--recorded", xl330.log.path, "--load-inertia", 0.005, "--json")
    assert said.code == 0, said.err
    (found,) = result_of(said.out)
    assert (found["joint"], found["scale"]) == ("elbow", "current")
    assert found["motor"]["resistance"] == pytest.approx(3.3801, rel=0.03)


def test_unknown_joint_of_a_log_is_refused(xl330, dxlrun):
    """Other refusals are in refusals.txt."""
    said = dxlrun("identify", "elbw", "--recorded", xl330.log.path)
    assert (said.code, "no joint elbw; did you mean elbow" in said.err) == (2, True)
