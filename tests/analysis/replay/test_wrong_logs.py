"""Logs with gaps, without an end, of other versions: what can be compared is, the rest is one sentence."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from tests.kit.changed_logs import Change, add, no_commands, only, plan, plan_text, versions, without
from tests.kit.judges import joints_of
from tests.kit.virtual_run import replayed

from dxlrun.cli import main
from dxlrun.errors import LogError, PlugInError
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.testing import VirtualRobot, plan_of, read_log
from dxlrun_analysis.replay import replay_log


def test_nothing_is_compared_behind_a_gap_or_a_lost_command(pair_log, changed):
    report = replay_log(changed(pair_log, without(*range(20, 25)), gaps=[("loop/cycles", 5)]))
    assert (report.cycles, report.compared, report.same) == (45, 20, True)
    assert report.stopped == (
        "the log lacks cycles between 20 and 24 (5 records of loop/cycles lost: overwritten or damaged "
        "before reading); the state of the controllers is unknown from cycle 25 on, so the comparison ends"
    )
    report = replay_log(changed(pair_log, no_commands()))
    assert (report.compared, report.same) == (10, True)
    assert report.stopped.startswith("the log lacks a command of cycle 10")


def of_controller(name: str, **other: object) -> Change:
    def edit(content: dict[str, dict[str, list[dict[str, object]]]]) -> None:
        (mine,) = (one for one in content["loop"]["controllers"] if one["name"] == name)
        mine |= other

    return plan(edit)


NO_PLAN = "this dxlrun cannot read the plan in the log"
BEGINNING = "needs the start of the run, but this log "
CONTRACT = (
    "the controllers of the run have contract 7, this dxlrun has contract 4; "
    "replay the log with dxlrun version 9.1"
)
NOT_TEXT = plan_text((b'"main"', b'"m\xffin"'), (b'"robot":"pair"', b'"robot":"p\xffir"'))
REFUSED: dict[str, tuple[Change, str]] = {
    "no first cycles": (only(slice(3, None)), f"{BEGINNING}begins with cycle 3; give the directory with all"),
    "no activation": (lambda log: replace(log, activation=None), f"{BEGINNING}has no /activation"),
    "no cycles": (only(slice(0)), "nothing to replay: "),
    "another contract": (versions(contract="7", dxlrun="9.1"), CONTRACT),
    "no plan": (plan(None), "no attachment plan.json"),
    "a plan that is none": (plan(b'{"robot": 5}'), NO_PLAN),
    "a plan that is not text": (NOT_TEXT, NO_PLAN),
    "a plan that is too deep": (plan(b'{"x": ' + b"[" * 200_000), NO_PLAN),
    "other joints": (plan(lambda plan: plan["loop"]["joints"].pop()), "plan and cycles differ in joints"),
    "other controllers": (
        plan(lambda plan: plan["loop"]["controllers"].reverse()),
        "plan and cycles differ in controllers",
    ),
    "no rate divider": (of_controller("head", every=0), "controller head of the plan has the rate divider 0"),
    "no such joint": (
        of_controller("head", joints=["neck"]),
        "controller head of the plan has the unknown joint neck",
    ),
    "no such command": (
        plan(lambda plan: plan["loop"]["commands"].clear()),
        "the plan in the log lacks a command of cycle 10",
    ),
    "a deadline": (add("scheduled_ns", 30, 10**12), "contradict its number"),
    "a wake-up": (add("woken_ns", 30, -(10**12)), "contradict its number"),
    "a number": (add("cycle", 30, 10**12), "contradict its number"),
    "a period": (add("period_ns", 30, 1), "cycle 30 had a period of 20000001 ns"),
}


def refused(log: Path, error: type[Exception] = LogError) -> str:
    with pytest.raises(error) as caught:
        replay_log(log)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("which", REFUSED)
def test_log_that_cannot_be_replayed_is_one_sentence(pair_log, changed, which):
    change, sentence = REFUSED[which]
    path = changed(pair_log, change)
    assert sentence in refused(path)
    if sentence == NO_PLAN:
        assert joints_of(read_log(path)) == {}


def test_missing_plug_in_and_parameters_that_the_installed_one_refuses(pair_log, changed):
    path = changed(pair_log, of_controller("all_inputs", type="gone"))
    assert refused(path, PlugInError) == (
        f"{path}: no plug-in offers the type gone of controller all_inputs; install all-inputs 1.0"
    )
    parameters = '{"joints": ["tilt", "nod"], "gian": 1}'
    path = changed(pair_log, of_controller("all_inputs", parameters=parameters))
    assert refused(path, PlugInError) == (
        "wrong controller parameters: all_inputs has an unknown key 'gian'; did you mean gain?"
    )


def test_other_versions_are_named(pair_log, changed):
    older = plan_text((b"all-inputs 1.0", b"all-inputs 0.9"))
    numpy, plugin = replay_log(changed(pair_log, versions(numpy="1.0"), older)).remarks
    assert numpy == f"numpy has version 1.0 in the run and {np.__version__} in the replay"
    came = "came from all-inputs 0.9 in the run and comes from all-inputs 1.0 in the replay"
    assert plugin == f"the controller type all_inputs {came}"


def test_parts_are_replayed_from_the_first_one_only(robot_file, tmp_path, capsys):
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
        assert f"a replay {BEGINNING}begins with cycle 1" in sentence


def test_log_that_ends_by_a_kill(tmp_path, pair_log):
    data, log = pair_log.read_bytes(), tmp_path / "killed.mcap"
    log.write_bytes(data[: data.index(b"dxlrun_summary") - 13])
    assert not read_log(log).complete
    report = replay_log(log)
    assert (report.compared, report.same) == (50, True)
    early = "the file ends early: the recorder was killed or could not write"
    assert report.remarks == (f"{early}; its last cycle is at 1.0 s of the run",)
