"""The disk that logs take: what a run says of it at its end and deletes if told to; `logs --prune`."""

import os
from pathlib import Path

import pytest
from rich.prompt import Confirm
from tests.kit.answers import result_of
from tests.kit.held_logs import being_written

from dxlrun.cli import run as cli_run
from dxlrun.cli.run import _disk_lines
from dxlrun.log import stored
from dxlrun.plan.recording_plan import RecordingPlan

ROBOT = """\
name: pan
loop: {rate: 50}
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
joints: {pan: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1}}
"""


@pytest.fixture
def logs(tmp_path, monkeypatch):
    """Four logs of 100 bytes, the second in parts, and files that are not logs of runs."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "logs"
    names = ["a_20260101_000000.mcap", "b_20260102_000000", "a_20260103_000000_2.mcap"]
    (folder / names[1]).mkdir(parents=True)
    files = [folder / names[0], folder / names[1] / "part_0000.mcap", folder / names[2]]
    for day, path in enumerate(files):
        path.write_bytes(bytes(100))
        os.utime(path, (1_000_000 + day, 1_000_000 + day))
    (folder / "a_20260104_000000.mcap").write_bytes(bytes(100))
    for other in ("thesis.mcap", "a_20260101_000000.txt"):
        (folder / other).write_bytes(bytes(100))
    (folder / "link_20260101_000000.mcap").symlink_to(folder / "thesis.mcap")
    return folder


def test_the_oldest_logs_of_runs_go_first_and_one_that_is_being_written_stays(logs):
    assert [one.bytes for one in stored.stored_logs(logs)] == [100] * 4

    def names(keep: int) -> list[str]:
        return [one.path.name for one in stored.oldest_beyond(logs, keep)]

    assert names(400) == []
    assert names(399) == ["a_20260101_000000.mcap"]
    assert names(200) == ["a_20260101_000000.mcap", "b_20260102_000000"]
    assert len(names(0)) == 4
    with (
        being_written(logs / "a_20260104_000000.mcap"),
        being_written(logs / "b_20260102_000000" / "part_0000.mcap"),
    ):
        assert names(0) == ["a_20260101_000000.mcap", "a_20260103_000000_2.mcap"]
    for one in stored.oldest_beyond(logs, 100):
        one.delete()
    assert sorted(path.name for path in logs.iterdir()) == [
        "a_20260101_000000.txt",
        "a_20260104_000000.mcap",
        "link_20260101_000000.mcap",
        "thesis.mcap",
    ]
    assert stored.stored_logs(logs / "none") == ()


def test_a_run_deletes_only_what_its_robot_file_says(logs, monkeypatch):
    last = logs / "a_20260103_000000_2.mcap"
    assert _disk_lines(last, RecordingPlan()) == []
    assert len(stored.stored_logs(logs)) == 4
    monkeypatch.setattr(stored, "MUCH_BYTES", 300)
    (line,) = _disk_lines(last, RecordingPlan())
    assert line.startswith(
        f"the logs in {logs} have 400 bytes; delete the oldest by `dxlrun logs {logs} --prune --keep "
    )
    assert len(stored.stored_logs(logs)) == 4
    lines = _disk_lines(last, RecordingPlan(keep_bytes=250))
    assert [line.split()[1] for line in lines] == [
        str(logs / "a_20260101_000000.mcap"),
        str(logs / "b_20260102_000000"),
    ]
    assert last.exists()
    monkeypatch.setattr(cli_run, "_MOST_DELETED", 0)
    lines = _disk_lines(logs / "a_20260104_000000.mcap", RecordingPlan(keep_bytes=0))
    assert lines == [f"deleted the 1 oldest log in {logs} because of `recording: {{keep: ...}}`"]


def test_a_run_names_the_size_of_its_log_and_keeps_what_its_robot_file_says(logs, dxlrun):
    Path("kept.yaml").write_text(f"{ROBOT}recording: {{keep: 1 kB}}\n")
    said = dxlrun("kept.yaml", "--virtual", "--duration", "0.1")
    assert said.code == 0, said.err
    assert " messages, " in said.out
    assert " kB)" in said.out
    assert said.out.count("deleted logs/") == 4
    assert (logs / "thesis.mcap").exists()


def test_pruning_shows_asks_and_deletes_only_after_a_yes(logs, monkeypatch, dxlrun):
    """Wrong words are in tests/cli/refusals.txt."""
    prune = ("logs", "logs", "--prune", "--keep")
    assert len(result_of(dxlrun(*prune, "0.1kB", "--json").out)["oldest"]) == 3
    said = dxlrun(*prune, "0.1kB")
    assert (said.code, "nothing was deleted" in said.err) == (2, True)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    for answer, left in ((False, 4), (True, 1)):
        monkeypatch.setattr(Confirm, "ask", lambda *_, answer=answer, **__: answer)
        assert dxlrun(*prune, "0.1kB").code == 0
        assert len(stored.stored_logs(logs)) == left
    assert "nothing to delete" in dxlrun(*prune, "1 GB").out
