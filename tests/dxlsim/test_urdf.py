"""Reading a URDF: what it says, and every mistake at its line and column."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from dxlsim.geometry.urdf import Mimic, UrdfLimits, leader, read_urdf
from dxlwire.exceptions import InputError

ARM = """\
<robot name="arm">
  <link name="base"/><link name="upper"/><link name="finger"/><link name="thumb"/>
  <joint name="elbow" type="revolute">
    <parent link="base"/><child link="upper"/>
    <origin xyz="1 2 3" rpy="0.1 0.2 0.3"/><axis xyz="0 3 4"/>
    <limit lower="-1" upper="2" velocity="3" effort="4"/>
  </joint>
  <joint name="thumb_slide" type="prismatic">
    <parent link="upper"/><child link="thumb"/><mimic joint="finger_slide" multiplier="-2" offset="0.5"/>
  </joint>
  <joint name="finger_slide" type="prismatic"><parent link="upper"/><child link="finger"/></joint>
</robot>
"""


def test_everything_is_read() -> None:
    urdf = read_urdf(ARM)
    elbow, thumb = urdf.joint("elbow"), urdf.joint("thumb_slide")

    assert (urdf.name, urdf.root, urdf.links) == ("arm", "base", ("base", "upper", "thumb", "finger"))
    assert elbow is not None
    assert (elbow.type, elbow.parent, elbow.child) == ("revolute", "base", "upper")
    assert (elbow.xyz, elbow.rpy, elbow.axis) == ((1, 2, 3), (0.1, 0.2, 0.3), (0, 0.6, 0.8))
    assert (elbow.limits, elbow.mimic) == (UrdfLimits(-1, 2, 3, 4), None)
    assert thumb is not None
    assert (thumb.axis, thumb.xyz, thumb.limits) == ((1, 0, 0), (0, 0, 0), UrdfLimits())
    assert thumb.mimic == Mimic("finger_slide", -2, 0.5)


def test_each_joint_stands_behind_the_one_above_it() -> None:
    chain = "".join(f'<link name="l{number}"/>' for number in range(3000))
    joints = "".join(
        f'<joint name="j{n}" type="fixed"><parent link="l{n}"/><child link="l{n - 1}"/></joint>'
        for n in range(1, 3000)
    )
    urdf = read_urdf(f"<robot>{chain}{joints}</robot>")

    assert urdf.root == "l2999"
    assert urdf.links == tuple(f"l{number}" for number in range(2999, -1, -1))


TWO_ROOTS = "2 links have no parent: base, lonely; connect all links to one tree, for example by fixed joints"
CIRCLE = "links form a circle: upper -> thumb -> upper; remove one joint of this circle"


@pytest.mark.parametrize(
    ("right", "wrong", "place", "expected"),
    [
        ('<link name="upper"/>', "<link/>", (2, 22), 'a link has no name; write <link name="...">'),
        ('name="thumb"', 'name="upper"', (2, 63), "link upper is defined twice; rename one of the links"),
        ('"thumb_slide" type', '"elbow" type', (8, 3), "joint elbow is defined twice; rename one"),
        (' name="elbow"', "", (3, 3), 'a joint has no name; write <joint name="..." type="...">'),
        (
            "revolute",
            "hinge",
            (3, 3),
            "joint elbow has the unknown type hinge; write one of revolute, continuous",
        ),
        ("revolute", "floating", (3, 3), "joint elbow is floating, with several degrees of freedom"),
        ("revolute", "planar", (3, 3), "joint elbow is planar, with several degrees of freedom"),
        (
            '<parent link="base"/>',
            "",
            (3, 3),
            'joint elbow has no parent; add <parent link="..."/>',
        ),
        (
            'link="base"',
            'link="bas"',
            (4, 5),
            "link bas, the parent of joint elbow, is not defined; did you mean base?",
        ),
        ('xyz="0 3 4"', 'xyz="0 0 0"', (5, 44), "the axis of joint elbow has zero length; write"),
        ('xyz="1 2 3"', 'xyz="1 2"', (5, 5), "xyz of the origin of joint elbow is '1 2', not three"),
        ('rpy="0.1', 'rpy="nan', (5, 5), "rpy of the origin of joint elbow is 'nan 0.2 0.3', not"),
        ('lower="-1"', 'lower="low"', (6, 5), "lower of the limit of joint elbow is 'low', not a number"),
        ('lower="-1"', 'lower="5"', (6, 5), "the lower limit of joint elbow, 5, is above the upper limit"),
        (
            'joint="finger_slide"',
            "",
            (9, 48),
            'the mimic of joint thumb_slide names no joint; write <mimic joint="..."/>',
        ),
        (
            'joint="finger_slide"',
            'joint="finger_slid"',
            (8, 3),
            "joint thumb_slide mimics the unknown joint finger_slid; did you mean finger_slide?",
        ),
        (
            'joint="finger_slide"',
            'joint="thumb_slide"',
            (8, 3),
            "joint thumb_slide mimics itself: thumb_slide -> thumb_slide; remove one mimic of this circle",
        ),
        (
            '<joint name="finger_slide" type="prismatic">',
            '<joint name="finger_slide" type="fixed">',
            (8, 3),
            "joint thumb_slide mimics the fixed joint finger_slide; name a moving joint",
        ),
        ('<link name="thumb"/>', '<link name="thumb"/><link name="lonely"/>', (2, 83), TWO_ROOTS),
        ('link="base"/><child', 'link="thumb"/><child', (3, 3), CIRCLE),
        (
            '<child link="finger"/>',
            '<child link="thumb"/>',
            (11, 3),
            "link thumb is the child of two joints, thumb_slide and finger_slide; change one child",
        ),
        ("robot", "model", (1, 1), "the top element is model, not robot; name a URDF file"),
        (ARM, "<robot/>", (1, 1), "the URDF has no links; add at least one link"),
    ],
)
def test_a_mistake_is_named_at_its_place(
    right: str, wrong: str, place: tuple[int, int], expected: str
) -> None:
    assert right in ARM
    with pytest.raises(InputError) as caught:
        read_urdf(ARM.replace(right, wrong), "arm.urdf")

    found = [f"{problem.what}; {problem.fix}" for problem in caught.value.problems]
    assert any(sentence.startswith(expected) for sentence in found), found
    marks = [problem.mark for problem in caught.value.problems]
    assert (marks[0].file, marks[0].line, marks[0].column) == ("arm.urdf", *place)


def test_all_mistakes_are_named_at_once() -> None:
    text = (
        ARM.replace("revolute", "hinge")
        .replace('multiplier="-2"', 'multiplier="two"')
        .replace("0 3 4", "0 0 0")
    )
    with pytest.raises(InputError) as caught:
        read_urdf(text)

    assert [problem.mark.line for problem in caught.value.problems] == [3, 9]


def test_a_body_that_is_a_circle_alone_is_named() -> None:
    joints = "".join(
        f'<joint name="{a}{b}" type="fixed"><parent link="{a}"/><child link="{b}"/></joint>'
        for a, b in ("ab", "ba")
    )
    with pytest.raises(InputError, match="links form a circle: "):
        read_urdf(f'<robot><link name="a"/><link name="b"/>{joints}</robot>')


def test_mimic_joints_in_a_circle_are_named_once_and_a_long_chain_of_them_is_fine() -> None:
    names = [f"j{number}" for number in range(1500)]
    links = "".join(f'<link name="{name}"/>' for name in ("base", *names))
    last = [*names[1:], ""]

    def joint(name: str, followed: str) -> str:
        mimic = f'<mimic joint="{followed}" multiplier="-1" offset="1"/>' if followed else ""
        ends = f'<parent link="base"/><child link="{name}"/>'
        return f'<joint name="{name}" type="revolute">{ends}{mimic}</joint>'

    chain = "".join(map(joint, names, last))
    joints = {each.name: each for each in read_urdf(f"<robot>{links}{chain}</robot>").joints}
    followed, scale, offset = leader(joints, joints["j0"], ["j1499"])
    assert followed.name == "j1499"
    assert scale * 0.25 + offset == pytest.approx(0.75)
    circle = "".join(map(joint, names, [*names[1:], "j1497"]))
    with pytest.raises(InputError) as caught:
        read_urdf(f"<robot>{links}{circle}</robot>")
    (problem,) = caught.value.problems
    assert problem.what == "joint j1497 mimics itself: j1497 -> j1498 -> j1499 -> j1497"


def test_a_comment_does_not_hide_a_doctype() -> None:
    with pytest.raises(InputError) as caught:
        read_urdf('<!-- <!DOCTYPE -->\n <!DOCTYPE r [<!ENTITY e "lol">]><robot>&e;</robot>')

    assert (caught.value.problems[0].mark.line, caught.value.problems[0].mark.column) == (2, 2)
    assert read_urdf("<!-- <!DOCTYPE --><robot><link name='a'/></robot>").root == "a"


def test_the_torso_has_the_tree_of_the_thesis() -> None:
    urdf = read_urdf((Path(__file__).parents[2] / "robots" / "urdf/bioloid_torso.urdf").read_text())

    assert urdf.links[:4] == ("world", "odom", "imu", "base_link")
    turning = [joint for joint in urdf.joints if joint.moves]
    assert len(turning) == 8
    assert all(math.hypot(*joint.axis) == 1.0 for joint in turning)
