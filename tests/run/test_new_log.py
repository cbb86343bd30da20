"""A log's name is taken before anything is written: two runs in one second, and directories that refuse."""

import contextlib
import errno
import os
from pathlib import Path

import pytest

from dxlrun.cli import main
from dxlrun.errors import InputError
from dxlrun.log.ledger_file import open_ledger
from dxlrun.log.log_writer import LogFile
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.run.run_log import discard_log, new_log

pytestmark = pytest.mark.long


def test_a_name_is_taken_once_and_discarding_leaves_the_logs_of_other_runs(tmp_path, monkeypatch):
    monkeypatch.setattr("time.strftime", lambda _: "20261121_120000")
    ours, *others = [new_log(RecordingPlan(str(tmp_path)), "pair") for _ in range(3)]
    assert [one.name for one in (ours, *others)] == [
        f"pair_20261121_120000{n}.mcap" for n in ("", "_2", "_3")
    ]
    discard_log(ours)
    assert {*tmp_path.iterdir()} == {*others}


def _virtual_run(directory: Path) -> None:
    robot = str(Path(__file__).parents[2] / "robots" / "bioloid_torso.yaml")
    words = [robot, "--virtual", "--duration", "0.1", "--ledger", "virtual.jsonl"]
    with contextlib.chdir(directory):
        assert main(words) == 0


@pytest.mark.parametrize(
    "create",
    [
        lambda directory: new_log(RecordingPlan(str(directory)), "pair"),
        lambda directory: LogFile(directory / "log.mcap").close(),
        lambda directory: open_ledger(directory / "bus.jsonl").close(),
        _virtual_run,
    ],
    ids=["name", "log", "ledger", "run"],
)
def test_logs_and_ledgers_are_for_the_user_and_the_group(tmp_path, create):
    before = os.umask(0)
    try:
        create(tmp_path)
    finally:
        os.umask(before)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert files
    assert {oct(path.stat().st_mode & 0o777) for path in files} == {"0o640"}


def test_a_directory_that_takes_no_file_is_an_input_error(tmp_path, monkeypatch):
    def refuse(path, mode, *, exist_ok):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    with pytest.raises(InputError, match="File name too long"):
        new_log(RecordingPlan(str(tmp_path)), "a" * 300)
    monkeypatch.setattr(Path, "touch", refuse)
    with pytest.raises(InputError, match=r"no log can be written in .*: Permission denied; .*--no-record"):
        new_log(RecordingPlan(str(tmp_path)), "pair")


def test_the_home_directory_is_meant_by_a_tilde(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert new_log(RecordingPlan(str(Path("~/logs"))), "pair").parent == tmp_path / "logs"
    with pytest.raises(InputError, match="write its absolute path"):
        new_log(RecordingPlan(str(Path("~nobody_of_this_name/logs"))), "pair")
