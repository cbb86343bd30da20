"""`dxlrun examples`: the robots that come along run where they are copied to, and those of gallery.md run."""

import re
import shutil
from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.commands import Dxlrun
from tests.kit.examples import as_parameters
from tests.kit.pages import page_commands, page_text

from dxlrun.cli import inputs
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.errors import DxlrunError

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
NAMES = sorted(path.stem for path in ROBOTS.glob("*.yaml"))
WITHOUT_MOTION = {
    "single_joint",
    "diff_drive",
    "leader_follower_two_ports",
    "koch",
    "wave",
    "open_manipulator_x_space",
    "koch_leads_open_manipulator_x",
    "koch_space",
} | {
    *("bioloid_torso_keyframes", "stand_up")  # theirs are in their own files
}


def test_gallery_md_has_a_picture_of_each_robot_and_each_runs(dxlrun: Dxlrun, reader: Path) -> None:
    robots = re.split(r"^## ", page_text("gallery.md"), flags=re.MULTILINE)[1:]
    lines = page_commands("gallery.md")
    assert len(robots) == len(lines) > 5
    assert all("](pictures/" in robot for robot in robots)
    for words in lines:
        ran = dxlrun(*words)
        assert ran.code == 0, (words, ran)


def test_every_robot_is_listed_with_its_motions(dxlrun: Dxlrun) -> None:
    said = dxlrun("examples")
    listed = {one["name"]: one for one in result_of(dxlrun("examples", "--json").out)}
    assert (said.code, sorted(listed)) == (0, NAMES)
    words = " ".join(said.out.split())
    assert all(f"{name} {one['servos']} " in words for name, one in listed.items())
    assert listed["bioloid_torso"]["motions"][0] == "three_parts"
    about = "A humanoid of twenty servos of Protocol 2.0 on four buses"
    assert listed["humanoid_20"]["about"].startswith(about)
    motions = {path.stem for path in ROBOTS.glob("motions/*.yaml")}
    assert {motion for one in listed.values() for motion in one["motions"]} == motions


@pytest.mark.parametrize("name", as_parameters(NAMES))
def test_copy_is_whole_and_is_what_it_was_copied_from(dxlrun: Dxlrun, tmp_path: Path, name: str) -> None:
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
    assert bool(play) == (name not in WITHOUT_MOTION)
    assert compile_files(target / f"{name}.yaml", {}, [Path(motion) for motion in play[1:]]).plan


def test_copy_goes_into_robots_and_may_be_made_again(
    dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    first, second = dxlrun("examples", "bioloid_torso.yaml"), dxlrun("examples", "robots/bioloid_torso.yaml")
    assert first == second
    assert first.out.splitlines()[0] == "robots/bioloid_torso.yaml"
    assert dxlrun("check", "robots/bioloid_torso.yaml").code == 0
    shown = result_of(dxlrun("examples", "diff_drive", "--json").out)
    assert shown["robot"] == shown["files"][0] == "robots/diff_drive.yaml"
    assert all(Path(file).is_file() for file in shown["files"])


def test_installed_package_takes_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "site-packages" / "dxlrun"
    monkeypatch.setattr(inputs, "__file__", str(package / "cli" / "inputs.py"))
    with pytest.raises(DxlrunError, match="has no examples"):
        inputs.examples_directory()
    shutil.copytree(ROBOTS, package / "examples")
    assert inputs.examples_directory() == package / "examples"
