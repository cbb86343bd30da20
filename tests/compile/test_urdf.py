from pathlib import Path

import pytest
from tests.kit.robots import PAIR, compile_text, problems_in

from dxlrun.errors import InputError, Mark

URDF = """\
<?xml version="1.0"?>
<robot name="pair">
  <link name="body"/><link name="left_arm"/><link name="right_arm"/>
  <joint name="left_arm_joint" type="revolute"><limit lower="-4.2" upper="1.05" velocity="1"/>
    <parent link="body"/><child link="left_arm"/></joint>
  <joint name="right_arm_joint" type="continuous"><parent link="body"/><child link="right_arm"/></joint>
</robot>
"""


def with_urdf(text: str) -> str:
    """Return a robot file that names a URDF of this text."""
    Path("pair.urdf").write_text(text, encoding="utf-8")
    return PAIR + "model: {urdf: pair.urdf}\n"


def test_a_urdf_that_fits_is_part_of_the_plan():
    compiled = compile_text(with_urdf(URDF))

    assert compiled.plan.urdf == URDF
    assert [warning for warning in compiled.warnings if "URDF" in warning.what] == []


def test_a_robot_without_one_has_none():
    assert compile_text(PAIR).plan.urdf is None


@pytest.mark.parametrize(
    ("right", "wrong", "expected"),
    [
        ("right_arm_joint", "other_joint", "the URDF has no joint right_arm_joint"),
        ("continuous", "fixed", "right_arm_joint cannot turn in the URDF"),
        (
            "-4.2",
            "-1",
            "left_arm_joint may move -240..+60 deg, beyond its limits in the URDF, -57.3..+60.16 deg",
        ),
    ],
)
def test_what_does_not_fit_is_a_warning(right: str, wrong: str, expected: str):
    (warning,) = [each for each in problems_in(with_urdf(URDF.replace(right, wrong))) if "URDF" in each.what]

    assert (warning.what, warning.severity) == (expected, "warning")


def test_a_speed_above_that_of_the_urdf_is_a_warning():
    text = with_urdf(URDF).replace("direction: -1", "direction: -1\n    limits: {velocity: 2 rad/s}")
    (warning,) = [each for each in problems_in(text) if "URDF" in each.what]

    assert warning.what == "left_arm_joint may move at 2 rad/s, faster than in the URDF, 1 rad/s"


@pytest.mark.parametrize(
    ("text", "place", "expected"),
    [
        ("<robot>\n  <link></robot>", (2, 11), "this is not XML (mismatched tag); correct it"),
        ("", (1, 1), "this is not XML (no element found); correct it"),
        ("<model/>", (1, 1), "the top element is model, not robot; name a URDF file"),
        (
            '<?xml version="1.0"?>\n <!DOCTYPE r [<!ENTITY e SYSTEM "file:///etc/passwd">]><robot>&e;</robot>',
            (2, 2),
            "DOCTYPE is not allowed; remove it",
        ),
        ("<robot>\x01</robot>", (1, 8), "the character U+0001 is not allowed in URDF; remove it"),
    ],
)
def test_what_is_no_urdf_is_an_error_at_its_place(text: str, place: tuple[int, int], expected: str):
    (error,) = [each for each in problems_in(with_urdf(text)) if each.severity == "error"]

    assert Path(error.mark.file).name == "pair.urdf"
    assert (error.mark.line, error.mark.column) == place
    assert f"{error.what}; {error.fix}" == expected


def test_a_missing_urdf_is_an_error_in_the_file_that_names_it():
    Path("sub").mkdir()
    Path("sub", "look.yaml").write_text("model: {urdf: gone.urdf}\n")
    with pytest.raises(InputError) as caught:
        compile_text(f"include: [sub/look.yaml]\n{PAIR}")

    (error,) = [each for each in caught.value.problems if each.severity == "error"]
    assert error.mark == Mark(str(Path.cwd() / "sub" / "look.yaml"), 1, 15)
    assert error.what == "URDF gone.urdf not found"


def test_the_urdf_of_a_fragment_lies_beside_the_fragment():
    Path("sub").mkdir()
    Path("sub", "look.yaml").write_text("model: {urdf: pair.urdf}\n")
    Path("sub", "pair.urdf").write_text(URDF)
    plan = compile_text(f"include: [sub/look.yaml]\n{PAIR}").plan

    assert plan.urdf == URDF
    assert plan.included == {"sub/look.yaml": "model: {urdf: pair.urdf}\n"}
