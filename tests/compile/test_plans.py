"""Plans as JSON, of today and of earlier versions; what two files or two plans together decide; graphs."""

import json
import re
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace
from tests.kit.pages import page_text
from tests.kit.robot_cases import compile_cases
from tests.kit.robots import CASES, PAIR, compile_text, problems_in, robot_text, whole_text

from dxlrun.compile.buses import slowest_period_ns
from dxlrun.compile.controller_graph import ControllerGraph, GraphEdge
from dxlrun.compile.policies import MARGIN_NS
from dxlrun.compile.robot_compiler import compile_files, compile_robot
from dxlrun.description.reading import read_robot
from dxlrun.errors import InputError
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan
from dxlrun.plan.robot_plan import SimulationPlan, from_json, to_json
from dxlwire.joint_unit import LINEAR
from dxlwire.plan import planning

INCOMPLETE = {CASES / "controllers.txt", CASES / "motion_form.txt"}  # an empty section, and no controllers
ROBOTS = sorted({*CASES.glob("*.txt")} - INCOMPLETE)
PHYSICS = pytest.mark.needs("physics")
MECHANICS = robot_text("mechanics")
POLICIES = robot_text("policies")
HUMANOID = Path(__file__).parents[2] / "robots" / "humanoid_20.yaml"
BUSES = ["right_arm", "left_arm", "right_leg", "left_leg"]


@pytest.mark.usefixtures("part_plugins")
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(
            path, id=path.stem, marks=PHYSICS if "physics: mujoco" in path.read_text("utf-8") else ()
        )
        for path in ROBOTS
    ],
)
def test_plan_of_each_robot_is_the_same_after_json(path: Path) -> None:
    compiled, problems = compile_cases(whole_text(path.read_text("utf-8").partition("====\n")[0]))
    assert compiled is not None, problems
    assert from_json(to_json(compiled.plan)) == compiled.plan


def test_joint_of_the_time_before_acceleration_limits_has_no_speed_limit() -> None:
    text = b'{"name":"j","lower":-1,"upper":1,"velocity":null,"top_speed":8.0}'
    old = msgspec.json.decode(text, type=JointPlan)
    assert (old.velocity, old.acceleration) == (None, None)


def test_plan_of_before_ratios_and_simulations_decodes_as_what_it_was() -> None:
    old = json.loads(to_json(compile_text(MECHANICS).plan))
    del old["mechanics"], old["simulation"]
    for servo in (servo for bus in old["buses"] for servo in bus["servos"]):
        for key in ("ratio", "name", "unit"):
            servo.pop(key, None)
    found = from_json(json.dumps(old).encode())
    assert (found.mechanics.coupled, found.simulation) == (False, SimulationPlan())
    assert {servo.ratio for bus in found.buses for servo in bus.servos} == {1.0}


def test_plan_of_log_format_8_has_the_units_of_its_joints() -> None:
    plan = replace(compile_text(MECHANICS).plan, source_text='a "linear":true inside a text')
    old = to_json(plan).replace(b'"unit":"m"', b'"linear":true').replace(b'"unit":"rad"', b'"linear":false')
    assert b'"unit"' not in old
    assert from_json(old) == plan
    assert [joint.name for joint in from_json(old).loop.joints if joint.unit is LINEAR] == ["grip"]


def test_model_that_a_servo_reported_replaces_auto() -> None:
    Path("robot.yaml").write_text(PAIR.replace("AX-12A", "auto"))
    models = {"left_arm_joint": "AX-12W", "right_arm_joint": "AX-12W"}
    compiled = compile_robot(read_robot(Path("robot.yaml"), {}), [], None, models)
    assert [servo.model for servo in compiled.plan.buses[0].servos] == ["AX-12W"] * 2
    assert [each for each in compiled.warnings if "model" in each.what] == []


def test_torque_of_a_servo_grows_with_its_gear_and_a_current_does_not() -> None:
    (head,) = compile_text(MECHANICS).joints[0].servos
    straight = replace(head, described=replace(head.described, ratio=1.0))
    assert head.top_effort == straight.top_effort
    torque = replace(head.table, effort_unit="Nm")
    assert replace(head, table=torque).top_effort == 2 * (replace(straight, table=torque).top_effort or 0.0)


def test_motion_gives_linear_joints_lengths() -> None:
    others = "hip: {position: 0 deg}, pitch: {position: 0 deg}, roll: {position: 0 deg}"
    motion = f"name: m\nmotions:\n- controller: all\n  points: [{{time: 1 s, joints: {{{others}, HEAD}}}}]\n"
    head = "head: {position: 5 deg}, grip: {position: 20 mm}"
    assert compile_text(MECHANICS, motion.replace("HEAD", head)).plan.loop.commands
    (problem,) = problems_in(MECHANICS, motion.replace("HEAD", head.replace("mm", "deg")))
    assert problem.what == "grip is linear, so its position cannot be in rad"


# Policies


def test_steps_that_take_too_long_say_what_would_do() -> None:
    (problem,) = problems_in(POLICIES.replace("exit_timeout: 6 s", "exit_timeout: 3 s"))
    assert "pose home at 90 deg/s: up to" in problem.what
    seconds = problem.fix.removeprefix("raise exit_timeout to ").split(" s,")[0]
    assert problems_in(POLICIES.replace("exit_timeout: 6 s", f"exit_timeout: {seconds} s")) == ()


def test_steps_leave_time_for_two_periods_and_for_torque_off() -> None:
    def limit_ns(text: str, timeout: str = "2 s") -> int:
        return compile_text(f"{text}policies: {{exit_timeout: {timeout}}}\n").plan.loop.policies.limit_ns

    at_50, slow = limit_ns(PAIR), PAIR.replace("rate: 50", "rate: 25")
    assert at_50 - limit_ns(slow) == 2 * 20_000_000
    exchanges = 2 * 2  # torque off and its read-back, of two servos
    assert at_50 - limit_ns(PAIR.replace("latency: 1 ms", "latency: 2 ms")) == exchanges * 1_000_000
    assert at_50 < 2_000_000_000 - 2 * 20_000_000 - MARGIN_NS - exchanges * 1_000_000
    assert limit_ns(slow, "150 ms") == 0  # too short for any step


def test_torque_is_not_reduced_where_a_servo_has_no_limit_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every model of today's tables has one; a plug-in may add a model without."""
    monkeypatch.setattr(planning, "_torque_limit", lambda table: None)
    (problem,) = problems_in(POLICIES)
    line = POLICIES.splitlines()[problem.mark.line - 1]
    assert line[problem.mark.column - 1 :].startswith("reduce_torque: 0.25")
    who = "the AX-12A of left_arm_joint has no torque limit in RAM (and 1 joint more)"
    assert problem.what == f"on_exit reduces torque, but {who}"


# Time budgets


def test_of_several_buses_the_shortest_watchdog_bounds_the_rate() -> None:
    (bus,) = compile_text(robot_text("watchdog")).plan.buses
    longer = replace(bus, watchdog_ticks=50)
    assert slowest_period_ns([bus, longer]) == slowest_period_ns([longer, bus]) == slowest_period_ns([bus])


def test_rate_of_a_full_bus_is_possible() -> None:
    rate = 1e9 / compile_text(PAIR).plan.buses[0].budget.total_ns
    loop = compile_text(PAIR.replace("rate: 50", f"rate: {rate!r}").replace(", rate: 25", "")).plan.loop
    assert loop.least_period_ns <= loop.period_ns


@pytest.mark.parametrize("rate", [3000, 7000, 30_000])
def test_rate_of_a_controller_divides_a_loop_whose_period_is_no_whole_number_of_ns(rate: int) -> None:
    text = PAIR.replace("{rate: 50}", f"{{rate: {rate}}}").replace("rate: 25}", f"rate: {rate // 2}}}")
    found = problems_in(text)
    assert found  # the bus is too slow
    assert [problem.what for problem in found if "of states" in problem.what] == []


def test_twenty_servos_on_four_buses_leave_half_of_a_millisecond_to_controllers():
    plan = compile_files(HUMANOID, {}, []).plan
    assert plan.loop.period_ns == 1_000_000
    assert [(bus.name, len(bus.servos), bus.latency_ns) for bus in plan.buses] == [(x, 5, 0) for x in BUSES]
    assert max(bus.budget.total_ns for bus in plan.buses) < 500_000
    leg = plan.buses[BUSES.index("left_leg")]
    assert leg.read_by == "fast sync read"  # the quickest way
    assert (leg.budget.request_bytes, leg.budget.reply_bytes) == (19 + 14 + 5 * 9, 8 + 5 * 14)
    assert plan.simulation.adapters == {}
    ftdi = compile_files(HUMANOID, {"adapter": "ftdi", "rate": "500"}, []).plan
    assert {bus.latency_ns for bus in ftdi.buses} == {1_000_000}
    assert [one.latency_timer_ns for one in ftdi.simulation.adapters.values()] == [1_000_000] * 4


@pytest.mark.parametrize(
    ("rate", "period", "too_fast"), [("719", "", []), ("720", "1.39 ms", BUSES), ("1000", "1 ms", BUSES)]
)
def test_highest_rate_that_is_named_is_possible_and_the_next_one_is_not(
    rate: str, period: str, too_fast: list[str]
):
    with pytest.raises(InputError) as caught:  # 50 Hz of the broadcaster divide neither 719 nor 720
        compile_files(HUMANOID, {"adapter": "ftdi", "rate": rate}, [])
    errors = [one for one in caught.value.problems if one.severity == "error"]
    found = [one for one in errors if "one cycle on bus" in one.what]
    assert [one.what.split()[4] for one in found] == too_fast
    for one in found:
        assert f"{rate} Hz (argument rate:={rate}) is {period}" in one.what
        assert "lower the rate to at most 719 Hz" in one.fix
        assert "an adapter without a latency timer would allow 2564 Hz" in one.fix


def test_character_that_is_not_allowed_in_a_urdf_is_refused_at_its_place() -> None:
    Path("pair.urdf").write_text("<robot>\x01</robot>")
    (error,) = [one for one in problems_in(f"{PAIR}model: {{urdf: pair.urdf}}\n") if one.severity == "error"]
    assert str(error).endswith("pair.urdf:1:8: the character U+0001 is not allowed in URDF; remove it")


@pytest.mark.usefixtures("part_plugins")
def test_right_graph_has_its_order_and_its_edges():
    loop = compile_text(robot_text("graph")).plan.loop
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


def test_the_chain_of_the_page_is_right():
    page = page_text("robot-file.md")
    (chain,) = [text for text in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if "into:" in text]
    assert problems_in(robot_text("controllers").replace("controllers:\n", "") + chain) == ()


def test_controller_that_reads_itself_is_warned_about_and_can_be_ordered() -> None:
    plan = ControllerPlan("low", "part", "", "{}", ("j",), ("effort",), (), True, 1)
    low = replace(plan, reference=("position",), reads=("low/j/position",))
    own = replace(
        plan, name="filter", joints=(), command=(), reads=("filter/x", "filter/age"), provides=("x",)
    )
    graph = ControllerGraph(("j",), (low, own))
    assert [*graph.find_mistakes()] == []
    assert graph.order == ("low", "filter")
    assert [one.what for one in graph.warnings()] == [
        "low reads low/j/position, its own reference",
        "filter reads filter/x, its own state of the previous cycle",
    ]
