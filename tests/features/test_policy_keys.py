"""A package with a policy of its own, the example of add-a-section.md, on virtual time."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from dxlrun import InputError, Log
from dxlrun.channels.event_records import EventCode
from dxlrun.cli import check
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.plan.robot_plan import from_json
from dxlrun.testing import installed, plan_of, read_log, simulated_robot
from dxlrun_analysis.replay.log_replay import replay_log

HOT = "policies: {on_hot_servo: {above: 70 degC, do: %s}}\n"
STEPS = "[{pose: rest, speed: 60 deg/s}, limp]"
OVERHEAT = f"poses: {{rest: {{tilt: 20 deg}}}}\npolicies: {{exit_timeout: 6 s, on_overheat: {STEPS}}}\n"
ROBOT = """\
name: pair
buses:
  main:
    port: sim
    protocol: 1.0
    baud_rate: 1_000_000
    return_delay_time: 100 us
    adapter: {latency: 1 ms}
    slow_registers: {items: [present_temperature], rate: 20}
loop: {rate: 50}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tilt: {bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: 1}
controllers:
  head: {type: joint_trajectory_controller, joints: [pan, tilt]}
"""
PROJECT = Path(__file__).parent / "hot_servo"


@pytest.fixture(autouse=True)
def with_package() -> Iterator[None]:
    """Let dxlrun find the package."""
    with installed(PROJECT):
        yield


class Ended(NamedTuple):
    """End of a run in which the servo of `pan` is hot from 0.5 s to 1 s."""

    reason: str
    detail: str
    torque: list[bool]
    """Torque of pan and tilt at 0.9 s."""
    events: list[tuple[str, str]]
    """Source and text of the events of policies."""
    log: Log


def run(path: Path, policies: str) -> Ended:
    file, torque, log = path / "pair.yaml", list[bool](), path / "run.mcap"
    file.write_text(ROBOT + policies)
    log.unlink(missing_ok=True)
    robot = simulated_robot(file, duration_s=1.5, log=log)
    bus = robot.buses[0]
    pan = bus.servo(3)

    def heat(celsius: float) -> None:
        pan.temperature = celsius

    bus.at(500_000_000, lambda: heat(75.0))
    bus.at(900_000_000, lambda: torque.extend(bus.servo(one).torque_on for one in (3, 7)))
    bus.at(1_000_000_000, lambda: heat(40.0))
    result = robot.run()
    read, report = read_log(log), replay_log(log)
    assert (report.compared, report.different, report.fault) == (len(read.cycles), 0, "")
    assert not any("not installed" in remark for remark in report.remarks)
    events = [(event.source, event.text) for event in read.events if event.code == EventCode.POLICY]
    return Ended(result.reason, result.detail, torque, events, read)


def test_hot_servo_becomes_limp(tmp_path):
    ended = run(tmp_path, HOT % "limp")
    assert (ended.reason, ended.torque) == ("ended", [False, True])
    assert ended.events == [("pan", "is hot; on_hot_servo: limp")]


def test_hot_servo_ends_the_run_which_says_why(tmp_path):
    ended = run(tmp_path, HOT % "stop")
    assert (ended.reason, ended.detail) == ("fault", "pan is hot; on_fault: limp")
    assert 25 <= len(ended.log.cycles) <= 40


def test_controllers_of_hot_servo_are_held_until_it_is_cool(tmp_path):
    ended = run(tmp_path, HOT % "hold")
    assert (ended.reason, ended.torque) == ("ended", [True, True])
    assert [event for event in ended.events if event[0] == "head"] == [
        ("head", "is held until all its joints are cool"),
        ("head", "resumes: all its joints are cool"),
    ]


def test_group_has_its_own_policy(tmp_path):
    groups = "policies: {groups: {neck: {joints: [%s], on_hot_servo: {above: 60 degC, do: limp}}}}\n"
    assert run(tmp_path, groups % "pan").torque == [False, True]
    assert run(tmp_path, groups % "tilt").torque == [True, True]
    both = groups.replace("{groups", "{on_hot_servo: {above: 65 degC, do: continue}, groups")
    assert run(tmp_path, both % "tilt").events == [("pan", "is hot; on_hot_servo: continue")]


def test_run_ends_by_the_steps_of_the_policy(tmp_path):
    ended = run(tmp_path, OVERHEAT)
    assert (ended.reason, ended.torque) == ("fault", [True, True])
    assert ended.detail == "a servo is above 72 degC; on_overheat: pose rest at 60 deg/s, then limp"
    assert ended.log.cycles["position"][-1][1] == pytest.approx(math.radians(20), abs=0.05)


def test_steps_of_the_policy_are_checked(tmp_path):
    file = tmp_path / "pair.yaml"
    file.write_text(ROBOT + OVERHEAT)
    rows = {row.name: row for row in compile_files(file, {}, []).report["policies"]}
    assert rows["on_overheat"].does == "pose rest at 60 deg/s, then limp"
    assert 2 < rows["on_overheat"].longest < 6
    file.write_text(ROBOT + OVERHEAT.replace("exit_timeout: 6 s", "exit_timeout: 2 s"))
    with pytest.raises(InputError, match="on_overheat may take "):
        plan_of(file)
    file.write_text(ROBOT + OVERHEAT.replace("pose: rest", "pose: nest"))
    with pytest.raises(InputError, match="the robot has no pose nest; did you mean rest"):
        plan_of(file)


def test_check_shows_the_policy(tmp_path, capsys):
    file = tmp_path / "pair.yaml"
    file.write_text(ROBOT + HOT % "hold")
    rows = {row.name: row.does for row in compile_files(file, {}, []).report["policies"]}
    assert list(rows)[-2:] == ["on_hot_servo", "on_returned_servo"]
    assert rows["on_hot_servo"] == "pan above 70 degC: hold, tilt above 70 degC: hold"
    assert check.check_robot(file) == 0
    assert "on_hot_servo" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("policies", "message"),
    [
        (
            "policies: {on_hot_servo: {above: 120 degC, do: stop}}",
            "no servo works at 120 degC",
        ),
        ("policies: {on_hot_servo: {do: limp}}", "policies.on_hot_servo has no above"),
        ("policies: {on_hot_servo: {above: 70 deg, do: stop}}", "70 degC"),
        ("policies: {groups: {a: {joints: [pan], on_hot_servo: {above: 70 degC, do: melt}}}}", "melt"),
    ],
)
def test_mistake_is_named_at_its_place(tmp_path, policies, message):
    file = tmp_path / "pair.yaml"
    file.write_text(f"{ROBOT}{policies}\n")
    with pytest.raises(InputError) as error:
        plan_of(file)
    (problem,) = error.value.problems
    assert message in f"{problem.what}; {problem.fix}"
    assert problem.mark.line == len(ROBOT.splitlines()) + 1


def test_robot_without_the_key_does_not_use_the_package(tmp_path):
    file = tmp_path / "pair.yaml"
    file.write_text(ROBOT + "policies: {exit_timeout: 3 s}\n")
    plan = plan_of(file)
    assert "on_hot_servo" not in {feature.name for feature in plan.features}
    assert "dxlrun_hot" not in plan.packages
    group = "{joints: [pan], on_lost_servo: limp}"
    file.write_text(f"{ROBOT}policies: {{groups: {{on_hot_servo: {group}}}}}\n")
    assert "dxlrun_hot" not in plan_of(file).packages
    file.write_text(ROBOT + HOT % "limp")
    assert plan_of(file).packages["dxlrun_hot"] == "dxlrun-hot"


def test_replay_without_the_package_says_so(tmp_path, monkeypatch):
    run(tmp_path, HOT % "limp")
    features = from_json(read_log(tmp_path / "run.mcap").attachments["plan.json"]).features
    assert features[-1].distribution == "dxlrun-hot 1.0"
    monkeypatch.setattr("dxlrun.features.installed_features", lambda: features[:-1])
    report = replay_log(tmp_path / "run.mcap")
    assert [remark for remark in report.remarks if "dxlrun-hot 1.0; it is not installed" in remark]
