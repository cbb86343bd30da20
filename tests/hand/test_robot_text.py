"""Values that are replaced in a robot file: every other byte is as it was."""

from pathlib import Path

import pytest
from tests.kit.hands import written

from dxlrun.errors import InputError
from dxlrun_hand.robot_text import RobotText

HEAD = "# a robot: ü 😀\nname: arm\nbuses: {main: {port: sim, protocol: 2.0, baud_rate: 57600}}\n"
REFERENCE, LIMITS = ("joints", "elbow", "reference"), ("joints", "elbow", "limits", "position")


def put(directory: Path, text: str, *changes: tuple[tuple[str, ...], str | list[str]]) -> str:
    """Return the text of a file after changes, through the disk."""
    path = written(directory, text)
    edited = RobotText(path)
    for place, value in changes:
        edited.plan_value(place, value)
    edited.write_files()
    return path.read_bytes().decode()


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("{id: 1, reference: 1 deg}", "{id: 1, reference: 2.5 deg}"),
        ("{ reference :  '1 deg' ,id: 1 }  # 1 deg", "{ reference :  2.5 deg ,id: 1 }  # 1 deg"),
        ("\n    id: 1\n    reference: 1 deg   # old\n", "\n    id: 1\n    reference: 2.5 deg   # old\n"),
        ("{id: 1}", "{id: 1, reference: 2.5 deg}"),
        ("{id: 1, }", "{id: 1, reference: 2.5 deg, }"),
        ("{\n    id: 1,  # first\n  }", "{\n    id: 1, reference: 2.5 deg,  # first\n  }"),
        ("\n    id: 1  # first\n\n# end\n", "\n    id: 1  # first\n    reference: 2.5 deg\n\n# end\n"),
        ("\n    id: 1", "\n    id: 1\n    reference: 2.5 deg"),
        (
            "\n    limits:\n      velocity: 1 rad/s\n",
            "\n    reference: 2.5 deg\n    limits:\n      velocity: 1 rad/s\n",
        ),
        (
            "\n    id: 1\n    limits:\n      velocity: 1 rad/s\n",
            "\n    id: 1\n    reference: 2.5 deg\n    limits:\n      velocity: 1 rad/s\n",
        ),
        (
            "{limits: &x {velocity: 1 rad/s}, registers: *x}",
            "{limits: &x {velocity: 1 rad/s}, reference: 2.5 deg, registers: *x}",
        ),
        ("{registers: *y}", "{reference: 2.5 deg, registers: *y}"),
    ],
)
def test_a_value_is_replaced_or_put_in(tmp_path: Path, before: str, after: str) -> None:
    for newline in ("\n", "\r\n"):
        for mark in ("", "\ufeff"):
            texts = [
                mark + (HEAD + "other: &y {a: 1}\njoints:\n  elbow: " + one).replace("\n", newline)
                for one in (before, after)
            ]
            assert put(tmp_path, texts[0], (REFERENCE, "2.5 deg")) == texts[1]


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("limits: {position: [-1 deg,  1 deg]}", "limits: {position: [-9 deg,  8 deg]}"),
        ("limits: {velocity: 1 rad/s}", "limits: {velocity: 1 rad/s, position: [-9 deg, 8 deg]}"),
        ("limits: {}", "limits: {position: [-9 deg, 8 deg]}"),
        ("id: 1", "id: 1, limits: {position: [-9 deg, 8 deg]}"),
    ],
)
def test_limits_are_two_values(tmp_path: Path, before: str, after: str) -> None:
    texts = [f"{HEAD}joints: {{elbow: {{{one}}}, wrist: {{{before}}}}}\n" for one in (before, after)]
    assert put(tmp_path, texts[0], (LIMITS, ["-9 deg", "8 deg"])) == texts[1]


def test_items_of_a_block_are_replaced_each(tmp_path: Path) -> None:
    text = HEAD + "joints:\n  elbow:\n    limits:\n      position:\n      - -1 deg  # low\n      - 1 deg\n"
    after = put(tmp_path, text, (LIMITS, ["-9 deg", "8 deg"]))
    assert after == text.replace("- -1 deg", "- -9 deg").replace("- 1 deg", "- 8 deg")


def test_what_an_included_file_has_is_changed_there(tmp_path: Path) -> None:
    fragment = written(tmp_path, "joints: {elbow: {id: 1, reference: 1 deg}}  # arm\n", "fragment.yaml")
    main = written(tmp_path, f"include: [fragment.yaml]\n{HEAD}joints: {{elbow: {{direction: 1}}}}\n")
    before = main.read_bytes()
    text = RobotText(main)
    text.plan_value(REFERENCE, "2 deg")
    assert [line for line in text.diff() if line.startswith(("+", "-"))] == [
        f"--- {fragment} (now)",
        f"+++ {fragment} (new)",
        "-joints: {elbow: {id: 1, reference: 1 deg}}  # arm",
        "+joints: {elbow: {id: 1, reference: 2 deg}}  # arm",
    ]
    text.write_files()
    assert fragment.read_text() == "joints: {elbow: {id: 1, reference: 2 deg}}  # arm\n"
    assert main.read_bytes() == before
    text = RobotText(main)
    text.plan_value(("joints", "elbow", "direction"), "-1")
    text.write_files()
    assert "direction: -1}" in main.read_text()


@pytest.mark.parametrize(
    ("joints", "said"),
    [
        ('{elbow: {reference: "${zero}"}}', "joints.elbow.reference comes from an argument; write the value"),
        ("{elbow: {reference: &r 1 deg}, wrist: {reference: *r}}", "reference is shared by an alias"),
        ("{elbow: &j {reference: 1 deg}, wrist: *j}", "joints.elbow.reference is shared by an alias"),
        ("{elbow: 3}", "joints.elbow is not a mapping; write it as a mapping"),
    ],
)
def test_what_cannot_be_replaced_is_refused_at_its_place(tmp_path: Path, joints: str, said: str) -> None:
    path = written(tmp_path, f"{HEAD}joints: {joints}\n")
    with pytest.raises(InputError) as refused:
        RobotText(path).plan_value(REFERENCE, "2 deg")
    assert said in str(refused.value)
    assert str(refused.value).startswith(f"{path}:4:")


def test_a_file_that_was_changed_meanwhile_is_left_alone(tmp_path: Path) -> None:
    path = written(tmp_path, HEAD + "joints: {elbow: {reference: 1 deg}}\n")
    text = RobotText(path)
    text.plan_value(REFERENCE, "2 deg")
    path.write_text("name: other\n")
    with pytest.raises(InputError, match="was changed by another program, and nothing was written"):
        text.write_files()
    assert path.read_text() == "name: other\n"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_cannot_be_written_is_refused_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path, HEAD + "joints: {elbow: {reference: 1 deg}}\n")
    monkeypatch.setattr("os.access", lambda *_: False)  # root may write everything
    with pytest.raises(InputError, match="is read-only; make"):
        RobotText(path).check_path(REFERENCE)


def test_rights_and_links_stay(tmp_path: Path) -> None:
    path = written(tmp_path, HEAD + "joints: {elbow: {reference: 1 deg}}\n")
    path.chmod(0o640)
    link = tmp_path / "link.yaml"
    link.symlink_to(path)
    text = RobotText(link)
    text.plan_value(REFERENCE, "2 deg")
    text.write_files()
    assert link.is_symlink()
    assert "2 deg" in path.read_text()
    assert path.stat().st_mode & 0o777 == 0o640
