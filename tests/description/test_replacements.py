"""Values that replace those of a robot file: `dxlrun calibrate` checks its result so before it is written."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.kit import desk

from dxlrun.description.document import KeyPath
from dxlrun.description.reading import Replacement, read_robot

TEXT = """name: one
arguments:
  rate: {default: 50}
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000}
loop: {rate: "${rate}"}
joints:
  joint:
    {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1, limits: {position: [-90 deg, 90 deg]}}
"""


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.yaml").write_text(TEXT)
    return Path("robot.yaml")


def test_a_value_is_replaced_in_a_mapping_in_a_list_and_where_an_argument_stands(robot: Path) -> None:
    replacements = [
        Replacement(("joints", "joint", "limits", "position", 1), "1 rad"),
        Replacement(("loop", "rate"), 80),
        Replacement(("joints", "joint", "registers", "d_gain"), 8),  # the file has none
    ]
    found, untouched = read_robot(robot, {}, replacements).robot, read_robot(robot, {}).robot
    assert found.joints["joint"].limits.position == (pytest.approx(-1.5707963267948966), 1.0)
    assert found.joints["joint"].registers == {"d_gain": 8}
    assert (found.loop.rate, untouched.loop.rate) == (80.0, 50.0)


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        (("loop", "rate"), -1, "robot.yaml:6:14: loop.rate is -1, but must be at least 0.001; write for"),
        (("joints", "joint", "limits", "position", 1), "1", "robot.yaml:9:102: joints.joint.limits.position"),
        (("joints", "joint", "limits", "speed"), 1, "robot.yaml:9:73: joints.joint.limits has an unknown"),
        (("joints", "joint", "simulation", "inertia"), 1, "robot.yaml:8:3: joints.joint.simulation.inertia"),
    ],
)
def test_what_is_wrong_with_it_is_reported_at_its_place(
    robot: Path, place: KeyPath, value: object, problem: str
) -> None:
    (found,) = desk.caught(lambda: read_robot(robot, {}, [Replacement(place, value)]))
    assert found.startswith(problem)
