"""The controller graph in the file: every mistake at its line and column, all at once."""

# ruff: noqa: E501  lines of robot files
from __future__ import annotations

import re
from pathlib import Path

import pytest
from tests.kit import desk
from tests.kit.robots import compile_text, problems_in

from dxlrun.compile.graph import ControllerGraph, GraphEdge
from dxlrun.plan.loop_plan import ControllerPlan

pytestmark = pytest.mark.usefixtures("part_plugins")

ROBOT = """\
name: chains
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
loop: {rate: 100}
joints:
  shoulder: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1}
  elbow: {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: 1}
  wrist: {bus: main, id: 3, model: XM430-W350, reference: 180 deg, direction: 1}
controllers:
"""
GOOD = """\
  arm: {type: part, joints: [shoulder, elbow], command: [position, velocity], into: limiter, rate: 25}
  watch: {type: part, reads: [wrist/temperature, arm_pid/elbow/position]}
  limiter:
    type: part
    joints: [elbow, shoulder]
    command: [position, velocity]
    exports: [position, velocity]
    into: [arm_pid]
    rate: 50
  arm_pid: {type: part, joints: [shoulder, elbow], command: [effort], exports: [position, velocity, effort]}
  feed: {type: part, joints: [elbow], command: [effort], into: arm_pid}
  hand: {type: part, joints: [wrist], command: [position], fallback: still}
  still: {type: part, joints: [wrist], command: [position], active: false}
"""
PAIR = """\
  up: {type: part, joints: [shoulder], command: [position], into: low}
  low: {type: part, joints: [shoulder], command: [position], exports: [position]}
"""


def test_a_right_graph_has_no_problem_and_its_order():
    loop = compile_text(ROBOT + GOOD).plan.loop

    graph = ControllerGraph(joints=("shoulder", "elbow", "wrist"), controllers=loop.controllers)
    assert graph.order == ("arm", "limiter", "feed", "watch", "arm_pid", "hand", "still")
    assert [edge for edge in graph.edges if edge.joint == "elbow" and edge.kind != "command"] == [
        GraphEdge("reference", "arm", "limiter", "elbow", ("position", "velocity")),
        GraphEdge("read", "arm_pid", "watch", "elbow", ("position",)),
        GraphEdge("reference", "limiter", "arm_pid", "elbow", ("position", "velocity")),
        GraphEdge("reference", "feed", "arm_pid", "elbow", ("effort",)),
    ]
    assert GraphEdge("command", "arm_pid", "shoulder", "shoulder", ("effort",)) in graph.edges
    assert GraphEdge("read", "wrist", "watch", "wrist", ("temperature",)) in graph.edges


ONE = [
    # into
    (PAIR.replace("into: low", "into: §lwo"), "up is into lwo, which is no controller", "did you mean low?"),
    (PAIR.replace("into: low", "into: [§lwo]"), "up is into lwo, which is no controller", "did you mean low?"),
    (PAIR.replace("into: low", "into: [low, §low]"), "up is into low twice", "once"),
    (PAIR.replace("into: low", "into: §up"), "up is into itself", "name the controller"),
    (
        PAIR.replace(", exports: [position]", ", active: false").replace("into: low", "active: false, into: §low"),
        "up is into low, which exports no reference",
        "no controller of the robot exports any",
    ),
    (
        PAIR.replace("command: [position], into: low", "into: §low"),
        "up is into low, but commands nothing",
        "take `into` out",
    ),
    (
        PAIR.replace("[shoulder], command: [position], into", "[shoulder, §elbow], command: [position], into"),
        "up commands elbow, which low does not export",
        "take it out; exported: shoulder",
    ),
    (
        PAIR.replace("command: [position], into: low", "command: [position, velocity, effort], into: §low"),
        "up commands velocity and effort of shoulder, which low does not export",
        "low exports position",
    ),
    (
        PAIR.replace("[shoulder], command: [position], into: low", "[§shoulder], command: [position], into: [low, two]")
        + "  two: {type: part, joints: [shoulder], exports: [position]}\n",
        "shoulder of up is exported by low and two",
        "let one of them export it",
    ),
    (
        PAIR.replace("into: low", "into: [low, §two]")
        + "  two: {type: part, joints: [elbow], exports: [position]}\n",
        "up is into two, which exports none of its joints",
        "take two out",
    ),
    # activity, rates
    (
        PAIR.replace("into: low", "into: §low").replace("exports:", "active: false, exports:"),
        "up is active from the start, but low, which it commands, is not",
        "write active: true in low, or active: false in up",
    ),
    (
        PAIR.replace("into: low", "into: low, rate: §50").replace("exports:", "rate: 20, exports:"),
        "up is updated every 2 cycles, low, which it commands, every 5 cycles",
        "give up the rate of low or a whole fraction of it: 20",
    ),
    (
        PAIR.replace("into: low", "into: §low").replace("exports:", "rate: 20, exports:"),
        "up is updated every cycle, low, which it commands, every 5 cycles",
        "give up the rate of low",
    ),
    # circles
    (
        """\
  a: {type: part, joints: [shoulder], command: [position], exports: [position], into: §b}
  b: {type: part, joints: [shoulder], command: [position], exports: [position], into: [c]}
  c: {type: part, joints: [shoulder], command: [position], exports: [position], into: a}
""",
        "controllers command each other in a circle: a -> b -> c -> a",
        "take one of these steps out",
    ),
    (
        """\
  low: {type: part, joints: [shoulder, elbow], command: [position], exports: [position]}
  §a: {type: part, joints: [shoulder], command: [position], into: low, reads: [low/elbow/position]}
  b: {type: part, joints: [elbow], command: [position], into: low, reads: [low/shoulder/position]}
""",
        "controllers wait for each other, by `into` and by `reads`: a -> b -> a",
        "take one of these steps out",
    ),
    # claims
    (
        PAIR + "  two: {type: part, joints: [§shoulder], command: [position], into: low}\n",
        "two and up are both active and both command low/shoulder/position",
        "write active: false in one of the two",
    ),
    (
        PAIR + "  also: {type: part, joints: [§shoulder], command: [position]}\n",
        "also and low are both active and both claim shoulder (chain up -> low)",
        "write active: false in one of the two, or take the joint out",
    ),
    (
        PAIR
        + PAIR.replace("up", "up2").replace("low", "low2").replace("[shoulder], command: [position], ex", "[§shoulder], command: [position], ex"),
        "low2 and low are both active and both claim shoulder (chains up2 -> low2 and up -> low)",
        "write active: false",
    ),
    (
        """\
  top: {type: part, joints: [elbow, wrist], command: [position], into: §[a, b], active: false}
  a: {type: part, joints: [elbow, shoulder], command: [position], exports: [position], active: false}
  mid: {type: part, joints: [shoulder], command: [position], active: false}
  b: {type: part, joints: [wrist, shoulder], command: [position], exports: [position], active: false}
""",
        "top needs top -> a and top -> b together, and both command shoulder",
        "take these joints out of one of the two",
    ),
    (
        """\
  top: {type: part, joints: [elbow, wrist], command: [position], into: §[a, b]}
  a: {type: part, joints: [elbow, shoulder], command: [position], exports: [position]}
  b: {type: part, joints: [wrist, shoulder], command: [position], exports: [position]}
""",
        "top needs top -> a and top -> b together, and both command shoulder",
        "let one end in the other",
    ),
    # fallbacks
    (
        PAIR.replace("exports:", "fallback: §back, exports:")
        + "  back: {type: part, joints: [shoulder], command: [position], into: low, active: false}\n",
        "the fallback back of low commands low (back -> low), which has failed then",
        "not above it",
    ),
    (
        PAIR.replace("into: low", "into: low, fallback: §back")
        + "  back: {type: part, joints: [shoulder, wrist], command: [position], active: false}\n"
        + "  hand: {type: part, joints: [wrist], command: [position]}\n",
        "fallback back of up claims joints of hand, which stays active",
        "take these joints out",
    ),
    (
        PAIR.replace("[shoulder]", "[shoulder, elbow]").replace("[shoulder, elbow], command: [position], into: low", "[shoulder], command: [position], into: low, fallback: §back")
        + "  other: {type: part, joints: [elbow], command: [position], into: low}\n"
        + "  back: {type: part, joints: [shoulder], command: [position], active: false}\n",
        "fallback back of up claims joints of low, which stays active",
        "take these joints out",
    ),
    (
        PAIR.replace("into: low", "into: low, fallback: §back")
        + "  back: {type: part, joints: [wrist], command: [position], active: false, into: third}\n"
        + "  third: {type: part, joints: [wrist], command: [position], exports: [position], active: false}\n"
        + "  hand: {type: part, joints: [wrist], command: [position]}\n",
        "fallback back of up claims joints of hand through third, which stays active",
        "take these joints out",
    ),
    # reads
    ("  w: {type: part, reads: [§elbo/position]}\n", "w reads elbo/position, but there is no joint elbo", "elbow?"),
    ("  w: {type: part, reads: [§position]}\n", "that is no interface", "write JOINT/position"),
    (
        "  w: {type: part, reads: [elbow/position, §elbow/torque]}\n",
        "w reads elbow/torque, but elbow has no interface torque",
        "it has position, velocity, effort, temperature, voltage, age",
    ),
    ("  w: {type: part, reads: [§imu/orientation]}\n", "there is no joint imu", "known:"),
    (
        PAIR + "  w: {type: part, reads: [§lwo/shoulder/position]}\n",
        "w reads lwo/shoulder/position, but there is no controller lwo",
        "did you mean low?",
    ),
    (
        PAIR + "  w: {type: part, reads: [§up/shoulder/position]}\n",
        "up exports no reference",
        "read a joint",
    ),
    (
        PAIR + "  w: {type: part, reads: [§low/position]}\n",
        "low is a controller",
        "name a joint too: low/shoulder/position",
    ),
    (
        PAIR + "  w: {type: part, reads: [§low/elbow/position]}\n",
        "low does not export elbow",
        "exported: shoulder",
    ),
    (
        PAIR + "  w: {type: part, reads: [§low/shoulder/effort]}\n",
        "low/shoulder has no interface effort",
        "it has position",
    ),
    (
        PAIR + "  w: {type: part, reads: [§wirst/position, wirst/velocity, wirst/age]}\n",
        "w reads wirst/position and 2 more of it, but there is no joint wirst",
        "did you mean wrist?",
    ),
    (
        PAIR + "  w: {type: part, takeovers: [§lwo]}\n",
        "w activates lwo, which is not defined",
        "did you mean low?",
    ),
    (
        PAIR + "  w: {type: part, takeovers: [up, §w]}\n",
        "w activates itself",
        "name another controller",
    ),
    (
        PAIR + "  back: {type: part, joints: [shoulder], command: [position], active: false}\n"
        "  w: {type: part, takeovers: [§low, back]}\n",
        "w activates what cannot be active together: controllers low and back both command joint shoulder",
        "take one of them out",
    ),
]  # fmt: skip


def test_a_clash_of_others_is_no_mistake_of_a_fallback() -> None:
    (problem,) = problems_in(
        ROBOT
        + """\
  one: {type: part, joints: [wrist], command: [position]}
  two: {type: part, joints: [wrist], command: [position]}
  up: {type: part, joints: [shoulder], command: [position], fallback: back}
  back: {type: part, joints: [shoulder], command: [position], active: false}
"""
    )
    assert problem.what.startswith("two and one are both active and both claim wrist")


@pytest.mark.parametrize(("controllers", "what", "fix"), ONE, ids=[what[:60] for _, what, _ in ONE])
def test_one_mistake_is_one_problem_with_its_place(controllers: str, what: str, fix: str):
    text, at = desk.marked(ROBOT + controllers)

    (problem,) = problems_in(text)

    assert what in problem.what
    assert fix in problem.fix
    assert f"{problem.mark.line}:{problem.mark.column}" == at


RIGHT = {
    "a fallback of the upper end may end in the same lower one": PAIR.replace("into: low", "into: low, fallback: back")
    + "  back: {type: part, joints: [shoulder], command: [position], into: low, active: false}\n",
    "a fallback of the upper end takes the servos of a lower one that nothing else uses": PAIR.replace(
        "into: low", "into: low, fallback: back"
    )
    + "  back: {type: part, joints: [shoulder], command: [position], active: false}\n",
    "a fallback of the lower end takes its servos": PAIR.replace("exports:", "fallback: back, exports:")
    + "  back: {type: part, joints: [shoulder], command: [position], active: false}\n",
    "two uppers meet on different joints and interfaces": """\
  a: {type: part, joints: [shoulder], command: [position], into: low}
  b: {type: part, joints: [elbow], command: [position], into: low}
  c: {type: part, joints: [elbow, shoulder], command: [effort], into: low}
  low: {type: part, joints: [shoulder, elbow], command: [position], exports: [position, effort]}
""",
    "interfaces that no servo follows together go into a controller": """\
  a: {type: part, joints: [shoulder], command: [effort, pwm, velocity], into: low}
  low: {type: part, joints: [shoulder], command: [position], exports: [velocity, effort, pwm]}
""",
    "an upper end has some joints here and some there, and the lower ends' joints are not all its own": """\
  a: {type: part, joints: [shoulder, elbow], command: [position], into: [left, right]}
  b: {type: part, joints: [shoulder], command: [position], into: elsewhere, active: false}
  left: {type: part, joints: [shoulder, wrist], command: [position], exports: [position]}
  right: {type: part, joints: [elbow], command: [position], exports: [position]}
  elsewhere: {type: part, joints: [shoulder], exports: [position], active: false}
""",
    "two that are into the same two, each with another joint at the same end": """\
  a: {type: part, joints: [shoulder, elbow], command: [position], into: [left, right]}
  b: {type: part, joints: [shoulder, wrist], command: [position], into: [spare, right]}
  left: {type: part, joints: [shoulder], command: [position], exports: [position]}
  spare: {type: part, joints: [shoulder], exports: [position]}
  right: {type: part, joints: [elbow, wrist], command: [position], exports: [position]}
""",
    "a lower end is slower than the loop and its upper end slower still": PAIR.replace("into: low", "into: low, rate: 10")
    .replace("exports:", "rate: 50, exports:"),
}  # fmt: skip


@pytest.mark.parametrize("controllers", RIGHT.values(), ids=RIGHT)
def test_what_is_right_is_accepted(controllers: str):
    assert problems_in(ROBOT + controllers) == ()


def test_a_takeover_that_changes_modes_is_slow_and_warned_of() -> None:
    soft = """\
  soft: {type: part, joints: [shoulder, elbow], command: [position, effort], active: false}
  spare: {type: part, joints: [shoulder], command: [position], active: false}
"""
    text, at = desk.marked(ROBOT + PAIR + soft + "  w: {type: part, takeovers: [§soft]}\n")
    (warning,) = compile_text(text).warnings
    assert warning.what == (
        "when w activates soft, shoulder and 1 more must change from position to effort position mode, with "
        "torque off for some cycles"
    )
    assert f"{warning.mark.line}:{warning.mark.column}" == at
    assert not compile_text(text.replace("takeovers: [soft]", "takeovers: [spare]")).warnings


def test_the_chain_of_the_page_is_right():
    page = (Path(__file__).parents[2] / "docs" / "robot-file.md").read_text()
    (chain,) = [text for text in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if "into:" in text]
    assert problems_in(ROBOT.replace("controllers:\n", "") + chain) == ()


def test_all_mistakes_are_listed_at_once():
    text = ROBOT + """\
  up: {type: part, joints: [shoulder, wrsit], command: [position], into: lwo}
  a: {type: part, joints: [shoulder], command: [position], exports: [position], into: b, rate: 33}
  b: {type: part, joints: [shoulder], command: [position], exports: [position], into: a, reads: [x/position]}
  c: {type: prat, into: [gone, up], fallback: nowhere}
  d: {type: part, joints: [elbow], command: [position], into: c}
  e: {type: part, joints: [elbow], command: [effort], into: b}
"""  # fmt: skip
    found = [(problem.mark.line, problem.what) for problem in problems_in(text)]

    assert [line for line, _ in found] == [9, 9, 10, 10, 11, 12, 12, 12, 14]
    assert "wrsit" in found[0][1]
    assert "lwo" in found[1][1]
    assert "a -> b -> a" in found[2][1]
    assert "33 Hz" in found[3][1]
    assert "x/position" in found[4][1]
    assert "prat" in found[5][1]
    assert "gone" in found[6][1]
    assert "nowhere" in found[7][1]
    assert "elbow" in found[8][1]


def test_what_is_into_a_controller_of_wrong_form_is_no_mistake_of_its_own():
    text = ROBOT + """\
  up: {type: part, joints: [shoulder], command: [position], into: [low]}
  low: {type: part, joints: [shoulder], command: [position], exports: [position], active: maybe}
"""  # fmt: skip
    (problem,) = problems_in(text)
    assert "active" in problem.what


@pytest.mark.parametrize(
    ("written", "what"),
    [("7", "names no controller"), ("[]", "names no controller"), ("[low, 7]", "must be text")],
)
def test_into_is_a_name_or_some(written: str, what: str):
    (problem, *_) = problems_in(ROBOT + PAIR.replace("into: low", f"into: {written}"))
    assert what in problem.what
    assert problem.mark.line == 9


def test_combinations_are_checked_only_for_servos():
    text = ROBOT + "  a: {type: part, joints: [shoulder], command: [effort, pwm]}\n"
    (problem,) = problems_in(text)
    assert "do not go together" in problem.what


@pytest.mark.parametrize(
    ("key", "what"),
    [
        ("exports: [torque]", "exports the reference interface torque"),
        ("exports: [position, position]", "exports a reference interface twice"),
        ("command: [position, position]", "asks for a command interface twice"),
    ],
)
def test_interfaces_have_names_that_are_known(key: str, what: str):
    (problem,) = problems_in(ROBOT + f"  a: {{type: part, joints: [shoulder], {key}}}\n")
    assert what in problem.what


def test_a_mistake_has_its_path_in_the_file() -> None:
    plan = ControllerPlan("up", "part", "", "{}", ("j",), ("position",), (), True, 1, into=("low",))
    (mistake,) = ControllerGraph(("j",), (plan,)).mistakes()
    assert mistake.at == ("controllers", "up", "into", 0)
    assert mistake.what == "up is into low, which is no controller of the robot"
