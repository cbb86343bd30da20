"""Included files and groups: places of values, and merging; values: torso.txt, included.txt, shared.txt."""

import functools
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit import desk
from tests.kit.cases import read_head
from tests.kit.desk import TORSO
from tests.kit.robots import CASES, robot_text

from dxlrun.description.document import KeyPath, confined, grow, literal, parse, read_file
from dxlrun.description.including import MOST_FILES, MOST_LEVELS, merged
from dxlrun.description.joints.groups import NAMING, without_groups
from dxlrun.description.motion import parse_motion
from dxlrun.errors import Mark

HEAD = read_head(CASES / "included.txt").partition("---- head.yaml\n")[2]


@pytest.fixture
def including() -> str:
    (Path.cwd() / "fragments").mkdir()
    desk.write(HEAD, "fragments/head.yaml")
    return f"include: [fragments/head.yaml]\n{TORSO}"


def test_values_of_both_files_keep_their_places_and_arguments(including: str) -> None:
    text = including.replace("joints:\n", "joints:\n  yaw: {id: 7, limits: {position: [-1 rad, 1 rad]}}\n", 1)
    marks = desk.robot(text.replace("controllers:\n", "controllers:\n  head: {joints: [swing]}\n")).marks
    main, fragment = str(Path.cwd() / "robot.yaml"), str(Path.cwd() / "fragments/head.yaml")
    assert marks.value("joints", "yaw", "id") == Mark(main, 12, 13)
    assert marks.value("joints", "yaw", "model") == Mark(fragment, 5, 35)
    assert marks.origins["joints", "yaw", "limits", "velocity"] == "speed:=1 rad/s"
    assert marks.origins["loop", "rate"] == "rate:=50"
    assert marks.value("controllers", "head", "joints", 0) == Mark(
        main, 16, 19
    )  # that of the fragment is gone


def test_depth_number_and_size_are_bounded() -> None:
    for number in range(MOST_LEVELS + 1):
        desk.write(f"include: [deep{number + 1}.yaml]\n", f"deep{number}.yaml")
    desk.write("{}", f"deep{MOST_LEVELS + 1}.yaml")
    names = [f"wide{number}.yaml" for number in range(MOST_FILES + 1)]
    for name in names:
        desk.write("{}", name)
    for name in ("large1.yaml", "large2.yaml"):
        desk.write("#" * 600_000 + "\n{}", name)
    for includes, expected in (
        (["deep0.yaml"], f"nested deeper than {MOST_LEVELS} files; include deep7.yaml in the robot file"),
        (names, f"more than {MOST_FILES} files are included; merge some of them"),
        (
            ["large1.yaml", "large2.yaml"],
            "with large2.yaml the robot file is larger than 1024 KiB; shorten one of its files",
        ),
    ):
        problems = desk.refusals(f"include: [{', '.join(includes)}]\n{TORSO}")
        assert any(problem.endswith(expected) for problem in problems), problems


def test_fragment_that_is_a_directory_is_named_at_the_include() -> None:
    (Path.cwd() / "folder.yaml").mkdir()
    said = "robot.yaml:1:11: folder.yaml: this is a directory; name a YAML file"
    assert desk.refusals(f"include: [folder.yaml]\n{TORSO}") == [said]


@pytest.mark.parametrize("way", ["../secret.yaml", "inner/../../secret.yaml", "link.yaml"])
def test_file_outside_of_the_permitted_folder_is_not_read(way: str) -> None:
    folder = Path.cwd() / "robot"
    (folder / "inner").mkdir(parents=True)
    desk.write("loop: {rate: 10}\n", "secret.yaml")
    (folder / "link.yaml").symlink_to(Path.cwd() / "secret.yaml")
    (folder / "own.yaml").write_text("loop: {rate: 10}\n")
    with confined(folder):
        assert read_file(folder / "inner/../own.yaml")
        with pytest.raises(PermissionError, match="outside the permitted folder"):
            read_file(folder / way)


KEYS = st.sampled_from(["a", "b", "c"])
DOCUMENTS = st.dictionaries(
    KEYS, st.recursive(st.integers(0, 9), lambda below: st.dictionaries(KEYS, below), max_leaves=6)
)


def laid_over(low: dict[str, Any], high: dict[str, Any]) -> dict[str, Any]:
    both = {
        key: laid_over(low[key], high[key])
        for key in low.keys() & high.keys()
        if isinstance(low[key], dict) and isinstance(high[key], dict)
    }
    return low | high | both


def leaves(value: object, path: KeyPath = ()) -> dict[KeyPath, object]:
    if not isinstance(value, dict) or not value:
        return {path: value}
    return {k: v for key, below in value.items() for k, v in leaves(below, (*path, key)).items()}


@settings(max_examples=150, deadline=None)
@given(st.lists(DOCUMENTS, min_size=1, max_size=4))
def test_merging_is_deep_and_each_value_keeps_the_mark_of_its_file(documents: list[dict[str, Any]]) -> None:
    grown = [grow(parse(json.dumps(each), str(n)), str(n), literal) for n, each in enumerate(documents)]
    result = merged(grown)
    assert result.data == functools.reduce(laid_over, documents)
    for path, value in leaves(result.data).items():
        file = int(result.marks.value(*path).file)
        assert leaves(documents[file])[path] == value
        assert not any(path in leaves(later) for later in documents[file + 1 :])
    places = {path[:end] for path in leaves(result.data) for end in range(len(path) + 1)}
    assert set(result.marks.values) == places  # none of what was replaced
    assert set(result.marks.keys) == set(result.marks.values) - {()}


ROBOT = robot_text("shared")


def test_a_group_stands_for_its_joints_in_parameters_of_any_depth() -> None:
    steps = [{"pose": {"left": 0, "knee": 1}, "torque": {"body": 2}}]
    assert without_groups({"steps": steps, "into": ["left"]}, desk.robot(ROBOT).groups) == {
        "steps": [
            {"pose": {"shoulder": 0, "elbow": 0, "knee": 1}, "torque": {"shoulder": 2, "elbow": 2, "knee": 2}}
        ],
        "into": ["left"],  # a controller of that name
    }
    assert set(NAMING) == {"joints", "pose", "torque"}


def test_values_keep_their_places() -> None:
    description = desk.robot(ROBOT)
    file, marks = str(description.path), description.marks
    assert marks.key("joints", "knee", "model") == Mark(file, 5, 3)
    assert marks.value("joints", "elbow", "registers", "position_p_gain") == Mark(file, 11, 50)
    assert marks.value("joints", "shoulder", "registers", "position_d_gain") == Mark(file, 16, 87)
    assert marks.value("controllers", "all_joints", "joints", 0) == Mark(file, 19, 64)
    assert marks.value("controllers", "all_joints", "joints", 2) == Mark(file, 19, 70)
    turned = desk.robot(ROBOT.replace("[knee, left]", "[left, knee]")).marks  # one behind a group
    columns = [turned.value("controllers", "all_joints", "joints", index).column for index in range(3)]
    assert columns == [64, 64, 70]
    assert marks.key("poses", "home", "knee") == Mark(file, 21, 10)
    assert marks.key("poses", "home", "elbow") == Mark(file, 21, 23)


def test_motions_name_groups() -> None:
    groups = desk.robot(ROBOT).groups
    text = (
        "name: m\nmotions:\n- controller: all_joints\n  points:\n"
        "  - {time: 1 s, joints: {left: {position: 0 rad}, knee: {position: 1 rad}}}\n"
    )
    motion = parse_motion(text, Path("m.yaml"), groups)
    assert list(motion.motion.motions[0].points[0].joints) == ["shoulder", "elbow", "knee"]
    where = motion.marks.key("motions", 0, "points", 0, "joints", "elbow")
    assert where == Mark("m.yaml", 5, 26)
