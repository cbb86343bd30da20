"""Logs with gaps, without an end, of other versions: what can be compared is, the rest is one sentence."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from tests.kit.judges import joints_of
from tests.kit.stories import replayed

from dxlrun.cli import main
from dxlrun.errors import LogError, PlugInError
from dxlrun.log.reader import read_log
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.testing import VirtualRobot, plan_of
from dxlrun_analysis.replay import replay_log

Change = Callable[..., Path]


def refused(log: Path, error: type[Exception] = LogError) -> str:
    with pytest.raises(error) as caught:
        replay_log(log)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_nothing_is_compared_behind_a_gap(pair_log: Path, changed: Change) -> None:
    def change(content: Any) -> None:
        content.cycles = np.delete(content.cycles, range(20, 25))
        content.gaps = [("loop/cycles", 5)]

    report = replay_log(changed(pair_log, change))
    assert (report.cycles, report.compared, report.different) == (45, 20, 0)
    assert report.same
    assert report.stopped == (
        "the log misses cycles between 20 and 24 (5 records of loop/cycles were overwritten or damaged "
        "before the recorder read them); what the controllers knew after that is lost, so from cycle 25 on "
        "nothing is compared"
    )


def test_nothing_is_compared_behind_a_lost_command(pair_log: Path, changed: Change) -> None:
    def change(content: Any) -> None:
        content.commands.clear()

    report = replay_log(changed(pair_log, change))
    assert (report.compared, report.same) == (10, True)
    assert report.stopped.startswith("the log misses a command that cycle 10 took")


def test_a_log_without_its_beginning(pair_log: Path, changed: Change) -> None:
    def no_first_cycles(content: Any) -> None:
        content.cycles = content.cycles[3:]

    assert "needs the run's beginning, and this log begins with cycle 3; of a log in parts" in refused(
        changed(pair_log, no_first_cycles)
    )

    def no_activation(content: Any) -> None:
        content.activation = None

    assert "needs the run's beginning, and this log has no /activation" in refused(
        changed(pair_log, no_activation)
    )

    def no_cycles(content: Any) -> None:
        content.cycles = content.cycles[:0]

    assert "there is nothing to replay" in refused(changed(pair_log, no_cycles))


def test_parts_are_replayed_from_the_first_one_only(
    robot_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = plan_of(robot_file, play=[robot_file.with_name("look.yaml")], duration_s=1.0)
    log = tmp_path / "run"
    VirtualRobot(structs.replace(plan, recording=RecordingPlan(split_ns=300_000_000)), log=log).run()
    assert len(list(log.iterdir())) == 4
    assert len(replayed(log).cycles) == 50
    alone = replay_log(log / "part_0000.mcap")
    assert alone.same
    assert 0 < alone.compared < 20

    (log / "part_0000.mcap").unlink()
    for path in (log, log / "part_0001.mcap"):
        assert main(["replay", str(path)]) == 2
        (sentence,) = capsys.readouterr().err.splitlines()
        assert "a replay needs the run's beginning, and this log begins with cycle 1" in sentence


def test_a_log_that_ends_by_a_kill(tmp_path: Path, pair_log: Path) -> None:
    data = pair_log.read_bytes()
    log = tmp_path / "killed.mcap"
    log.write_bytes(data[: data.index(b"dxlrun_summary") - 13])
    assert not read_log(log).complete
    report = replay_log(log)
    assert (report.compared, report.same) == (50, True)
    assert report.remarks == ("the file has no end: its recorder was killed, or could write no more",)


def test_a_log_of_another_contract(pair_log: Path, changed: Change) -> None:
    def change(content: Any) -> None:
        content.metadata["versions"] |= {"contract": "7", "dxlrun": "9.1"}

    assert refused(changed(pair_log, change)).endswith(
        "the run's controllers were made for contract 7, this dxlrun has contract 4: "
        "replay it with the dxlrun that made it, version 9.1"
    )


def test_other_versions_are_named(pair_log: Path, changed: Change) -> None:
    def change(content: Any) -> None:
        content.metadata["versions"]["numpy"] = "1.0"
        plan = content.attachments["plan.json"]
        content.attachments["plan.json"] = plan.replace(b"all-inputs 1.0", b"all-inputs 0.9")

    numpy, plugin = replay_log(changed(pair_log, change)).remarks
    assert numpy == f"numpy was 1.0 in the run and is {np.__version__} in the replay"
    assert plugin == (
        "the controller type all_inputs came from all-inputs 0.9 in the run and comes from all-inputs 1.0 "
        "in the replay"
    )


def test_a_missing_plug_in(pair_log: Path, changed: Change) -> None:
    def change(content: Any) -> None:
        plan = content.attachments["plan.json"]
        content.attachments["plan.json"] = plan.replace(b'"type":"all_inputs"', b'"type":"gone"')

    path = changed(pair_log, change)
    assert refused(path, PlugInError) == (
        f"{path}: no plug-in offers the type gone of controller all_inputs; the run had it from "
        "all-inputs 1.0: install that"
    )


def test_parameters_that_the_installed_controller_refuses(pair_log: Path, changed: Change) -> None:
    def change(content: Any) -> None:
        plan = json.loads(content.attachments["plan.json"])
        (mine,) = (one for one in plan["loop"]["controllers"] if one["name"] == "all_inputs")
        mine["parameters"] = '{"joints": ["tilt", "nod"], "gian": 1}'
        content.attachments["plan.json"] = json.dumps(plan).encode()

    assert refused(changed(pair_log, change), PlugInError) == (
        "the parameters of a controller: all_inputs has an unknown key 'gian'; did you mean gain?"
    )


def test_a_plan_that_is_none_or_of_another_robot(pair_log: Path, changed: Change) -> None:
    def none(content: Any) -> None:
        del content.attachments["plan.json"]

    assert "no attachment plan.json" in refused(changed(pair_log, none))

    def wrong(content: Any) -> None:
        content.attachments["plan.json"] = b'{"robot": 5}'

    assert "is not one of this dxlrun" in refused(changed(pair_log, wrong))

    def other_joints(content: Any) -> None:
        plan = json.loads(content.attachments["plan.json"])
        plan["loop"]["joints"].pop()
        content.attachments["plan.json"] = json.dumps(plan).encode()

    assert "other joints" in refused(changed(pair_log, other_joints))

    def other_controllers(content: Any) -> None:
        plan = json.loads(content.attachments["plan.json"])
        plan["loop"]["controllers"].reverse()
        content.attachments["plan.json"] = json.dumps(plan).encode()

    assert "other controllers" in refused(changed(pair_log, other_controllers))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"every": 0}, "there is no rate divider 0, as controller head has it in the plan"),
        ({"joints": ["neck"]}, "there is no joint neck, as controller head has it in the plan"),
    ],
)
def test_a_plan_that_no_compiler_has_made(
    pair_log: Path, changed: Change, change: dict[str, object], says: str
) -> None:
    def damage(content: Any) -> None:
        plan = json.loads(content.attachments["plan.json"])
        (head,) = (one for one in plan["loop"]["controllers"] if one["name"] == "head")
        head |= change
        content.attachments["plan.json"] = json.dumps(plan).encode()

    assert says in refused(changed(pair_log, damage))


def test_a_plan_that_is_no_text(pair_log: Path, changed: Change) -> None:
    def damage(content: Any) -> None:
        plan = content.attachments["plan.json"]
        plan = plan.replace(b'"main"', b'"m\xffin"').replace(b'"robot":"pair"', b'"robot":"p\xffir"')
        content.attachments["plan.json"] = plan

    assert "the plan in the log is not one of this dxlrun" in refused(changed(pair_log, damage))
    assert joints_of(read_log(changed(pair_log, damage))) == {}


def test_a_plan_that_is_too_deep(pair_log: Path, changed: Change) -> None:
    def damage(content: Any) -> None:
        content.attachments["plan.json"] = b'{"x": ' + b"[" * 200_000

    assert "the plan in the log is not one of this dxlrun" in refused(changed(pair_log, damage))
    assert joints_of(read_log(changed(pair_log, damage))) == {}


def test_a_command_that_the_plan_has_not(pair_log: Path, changed: Change) -> None:
    def change(content: Any) -> None:
        plan = json.loads(content.attachments["plan.json"])
        plan["loop"]["commands"] = []
        content.attachments["plan.json"] = json.dumps(plan).encode()

    assert "cycle 10 took a command that the plan in the log has not" in refused(changed(pair_log, change))


@pytest.mark.parametrize("name", ["scheduled_ns", "woken_ns", "cycle"])
def test_times_that_no_loop_can_have_had(pair_log: Path, changed: Change, name: str) -> None:
    def change(content: Any) -> None:
        content.cycles[name][30] += -(10**12) if name == "woken_ns" else 10**12

    assert "contradict its number" in refused(changed(pair_log, change))


def test_a_period_that_was_given_otherwise(pair_log: Path, changed: Change) -> None:
    def change(content: Any) -> None:
        content.cycles["period_ns"][30] += 1

    assert "cycle 30 was given a period of 20000001 ns" in refused(changed(pair_log, change))
