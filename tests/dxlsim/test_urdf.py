"""Reading a URDF: what it says, and every mistake at its line and column."""

from pathlib import Path

import pytest
from tests.kit.cases import TextCase, case_parameters, read_head

from dxlsim.geometry.urdf import Mimic, UrdfLimits, leader, read_urdf
from dxlwire.exceptions import InputError

TEXT = Path(__file__).with_name("urdf_mistakes.txt")
ARM = read_head(TEXT)


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


@pytest.mark.parametrize("case", case_parameters(TEXT))
def test_a_mistake_is_named_at_its_place(case: TextCase) -> None:
    right, _, wrong = case.name.partition(" => ")
    ((_, told, _),) = case.lines
    assert right in ARM
    with pytest.raises(InputError) as caught:
        read_urdf(ARM.replace(right, wrong), "arm.urdf")
    problems = caught.value.problems
    said = [f"{one.mark.line}:{one.mark.column}: {one.what}; {one.fix}" for one in problems]
    assert any(sentence.startswith(told) for sentence in said), said
    assert problems[0].mark.file == "arm.urdf"


def test_a_urdf_without_links_is_named() -> None:
    with pytest.raises(InputError, match="the URDF has no links; add at least one link"):
        read_urdf("<robot/>")


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
