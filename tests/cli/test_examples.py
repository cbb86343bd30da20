"""`dxlrun examples`: the robots that come along run where they are copied to."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.examples import as_parameters

from dxlrun.cli import inputs
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.errors import DxlrunError

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
NAMES = sorted(path.stem for path in ROBOTS.glob("*.yaml"))


def test_every_robot_is_listed_with_its_motions(dxlrun: Callable):
    said = dxlrun("examples")
    listed = {one["name"]: one for one in result_of(dxlrun("examples", "--json").out)}

    assert said.code == 0
    assert sorted(listed) == NAMES
    words = " ".join(said.out.split())
    assert all(f"{name} {one['servos']} " in words for name, one in listed.items())
    assert listed["bioloid_torso"]["motions"][0] == "three_parts"
    assert listed["humanoid_20"]["about"].startswith(
        "A humanoid of twenty servos of Protocol 2.0 on four buses"
    )
    motions = {path.stem for path in ROBOTS.glob("motions/*.yaml")}
    assert {motion for one in listed.values() for motion in one["motions"]} == motions


@pytest.mark.parametrize("name", as_parameters(NAMES))
def test_a_copy_is_whole_and_is_what_it_was_copied_from(dxlrun: Callable, tmp_path: Path, name: str):
    target = tmp_path / "mine"

    said = dxlrun("examples", name, target)

    assert (said.code, said.err) == (0, "")
    *copied, hint = said.out.splitlines()
    assert copied[0] == str(target / f"{name}.yaml")
    assert {Path(each) for each in copied} == {path for path in target.rglob("*") if path.is_file()}
    for path in map(Path, copied):
        assert path.read_bytes() == (ROBOTS / path.relative_to(target)).read_bytes()
    command, robot, *play = hint.removeprefix("next: ").split()
    assert (command, robot) == ("dxlrun", copied[0])
    # one has no motion; those of three need arguments, those of two are in their own files
    own = {"single_joint", "diff_drive", "bioloid_torso_keyframes", "stand_up", "leader_follower_two_ports"}
    own |= {"koch", "wave"}
    assert bool(play) == (name not in own)
    assert compile_files(target / f"{name}.yaml", {}, [Path(motion) for motion in play[1:]]).plan


def test_it_goes_into_robots_and_may_be_copied_again(
    dxlrun: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)

    first, second = dxlrun("examples", "bioloid_torso.yaml"), dxlrun("examples", "robots/bioloid_torso.yaml")

    assert first == second
    assert first.out.splitlines()[0] == "robots/bioloid_torso.yaml"
    assert dxlrun("check", "robots/bioloid_torso.yaml").code == 0


def test_a_copy_is_reported_in_json_too(dxlrun: Callable, tmp_path: Path):
    shown = result_of(dxlrun("examples", "diff_drive", tmp_path, "--json").out)

    assert shown["robot"] == shown["files"][0] == f"{tmp_path}/diff_drive.yaml"
    assert all(Path(file).is_file() for file in shown["files"])


def test_what_was_changed_is_not_overwritten(dxlrun: Callable, tmp_path: Path):
    (tmp_path / "bioloid_torso.yaml").write_text("name: mine\n")

    said = dxlrun("examples", "bioloid_torso", tmp_path)

    assert said.code == 2
    assert said.errors == [
        f"dxlrun: {tmp_path}/bioloid_torso.yaml already exists with other contents; choose another directory"
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["bioloid_torso.yaml"]
    assert (tmp_path / "bioloid_torso.yaml").read_text() == "name: mine\n"


def test_a_directory_that_cannot_be_made_is_one_sentence(dxlrun: Callable, tmp_path: Path):
    (tmp_path / "file").touch()

    said = dxlrun("examples", "diff_drive", tmp_path / "file" / "x")

    assert said.code == 2
    assert len(said.errors) == 1
    assert "is not a directory)" in said.err


def test_an_installed_package_takes_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = tmp_path / "site-packages" / "dxlrun"
    monkeypatch.setattr(inputs, "__file__", str(package / "cli" / "inputs.py"))
    with pytest.raises(DxlrunError, match="has no examples"):
        inputs.examples_directory()
    shutil.copytree(ROBOTS, package / "examples")
    assert inputs.examples_directory() == package / "examples"
