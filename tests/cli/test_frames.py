"""`dxlrun frames`: the tree of the torso, poses, and what is refused; the commands of frames.md."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.answers import result_of
from tests.kit.pages import page_text

from dxlrun.errors import InputError
from dxlrun.testing import kinematics

ROOT = Path(__file__).parents[2]
TORSO = ROOT / "robots" / "bioloid_torso.yaml"
Dxlrun = Callable[..., Any]
PAIR = """\
name: pair
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
loop: {rate: 100}
joints:
  pan: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1}
model: {urdf: pair.urdf}
"""
URDF = """\
<robot name="pair"><link name="base"/><link name="head"/><link name="jaw"/><link name="chin"/>
<joint name="pan" type="revolute"><parent link="base"/><child link="head"/><axis xyz="0 0 1"/></joint>
<joint name="chin" type="revolute"><parent link="head"/><child link="chin"/>
<mimic joint="pan" multiplier="-2" offset="0.5"/></joint>
<joint name="jaw" type="prismatic"><parent link="head"/><child link="jaw"/>
<limit lower="0.01" upper="0.03" velocity="1" effort="1"/></joint>
</robot>
"""
DRAWN = """\
pair: 4 frames, 2 of them move; 30 Hz in the log
base
└── head      pan: revolute, axis 0 0 1, ID 1 on bus main
    ├── chin  chin: revolute, axis 1 0 0, -2 x pan +0.5
    └┄┄ jaw   jaw: prismatic, axis 1 0 0, without a servo: stays at 0.02
"""


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    (tmp_path / "pair.urdf").write_text(URDF)
    (tmp_path / "pair.yaml").write_text(PAIR)
    return tmp_path / "pair.yaml"


def test_the_tree_is_drawn(dxlrun: Dxlrun, pair: Path) -> None:
    done = dxlrun("frames", str(pair))

    assert (done.code, done.err) == (0, "")
    assert done.out == DRAWN


def test_the_tree_as_json_has_what_the_drawing_has(dxlrun: Dxlrun, pair: Path) -> None:
    found = result_of(dxlrun("frames", str(pair), "--json").out)

    assert (found["robot"], found["root"]) == ("pair", "base")
    rows = {row["frame"]: row for row in found["frames"]}
    assert [row["moved_by"] for row in rows.values()] == ["root", "servo", "mimic", "nothing"]
    assert rows["head"]["servo"] == "ID 1 on bus main"
    assert rows["chin"]["mimic"] == {"joint": "pan", "multiplier": -2.0, "offset": 0.5}
    assert rows["jaw"]["limits"]["upper"] == 0.03


def test_a_pose_is_printed_and_as_json(dxlrun: Dxlrun, pair: Path) -> None:
    words = (
        "frames",
        str(pair),
        "--of",
        "jaw",
        "--relative-to",
        "base",
        "--at",
        "pan=90deg",
        "jaw=5 mm",
    )
    printed = dxlrun(*words).out
    found = result_of(dxlrun(*words, "--json").out)

    assert "x y z           0.000000 0.005000 0.000000 m" in printed
    assert "roll pitch yaw  0.000 0.000 90.000 deg" in printed
    assert found["translation"] == pytest.approx([0, 0.005, 0])
    assert found["matrix"][1] == pytest.approx([1, 0, 0, 0.005])


def test_python_gets_the_same_pose(pair: Path) -> None:
    pose = kinematics(pair).pose("jaw", "base", {"pan": 1.0, "jaw": 0.02})

    assert pose.rpy == pytest.approx((0, 0, 1))
    assert pose.transform_point((0.0, 0.0, 1.0))[2] == 1


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--at", "pan=1rad"], "--at and --relative-to need a frame; name it by --of"),
        (["--of", "jam"], "frame jam not found; did you mean jaw?"),
        (["--of", "jaw", "--at", "pan"], "'pan' is not key=value; write for example --at elbow=30deg"),
        (["--of", "jaw", "--at", "pan=1"], "--at pan=1: '1' has no unit; write an angle with its unit"),
        (
            ["--of", "jaw", "--at", "jaw=1deg"],
            "--at jaw=1deg: '1deg' has the wrong unit deg for a",
        ),
        (["--of", "jaw", "--at", "pam=1rad"], "movable joint pam not found; did you mean pan?"),
        (["--of", "jaw", "--at", "pan=1rad", "--at", "pan=2rad"], "--at pan is given twice; give it once"),
        (["--graph", "tree.png"], "tree.png: the file's suffix must be .svg or .dot"),
    ],
)
def test_what_cannot_be_answered_is_refused(
    dxlrun: Dxlrun, pair: Path, words: list[str], expected: str
) -> None:
    done = dxlrun("frames", str(pair), *words)

    assert (done.code, done.out) == (2, "")
    assert expected in done.err
    assert done.err.count("\n") == 1


def test_a_robot_without_a_urdf_has_no_frames(dxlrun: Dxlrun, pair: Path) -> None:
    pair.write_text(PAIR.replace("model: {urdf", "# "))
    done = dxlrun("frames", str(pair))

    assert done.code == 2
    assert "has no URDF and so no frames; write `model: {urdf: NAME.urdf}`" in done.err
    with pytest.raises(InputError, match="has no URDF"):
        kinematics(pair)


def test_the_tree_is_drawn_into_a_file(dxlrun: Dxlrun, pair: Path, tmp_path: Path) -> None:
    for suffix in ("svg", "dot"):
        done = dxlrun("frames", str(pair), "--graph", str(tmp_path / f"tree.{suffix}"))
        assert f"the tree is in {tmp_path}/tree.{suffix}" in done.out
        assert "chin" in (tmp_path / f"tree.{suffix}").read_text()


def test_the_commands_of_the_page_work(
    dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of frames.md."""
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    monkeypatch.chdir(tmp_path)
    page = page_text("frames.md")
    lines = [line for line in re.findall(r"^    dxlrun (.+)$", page, re.MULTILINE) if "frames" in line]
    assert len(lines) > 2
    for line in lines:
        assert dxlrun(*shlex.split(line)).code == 0
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(compile(code, "frames.md", "exec"), {})  # noqa: S102  our own page
