"""`dxlrun replay` as a person types it, and docs/how-to/replay.md as it stands."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.changed_logs import no_commands, put, versions
from tests.kit.pages import page_text

from dxlrun.cli import main

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[3]
TEXT = page_text("replay.md")
COMMANDS = [line.strip() for line in TEXT.splitlines() if line.startswith("    dxlrun ")]
OUTPUTS = re.findall(r"```\n(.*?)```", TEXT, re.DOTALL)


def test_the_document_shows_the_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    monkeypatch.chdir(tmp_path)
    codes, said = [], []
    for line in COMMANDS:
        (log,) = sorted(Path("logs").glob("*.mcap"))[:1] or [tmp_path]
        codes.append(main(line.replace(" LOG", f" {log}").split()[1:]))
        said.append(capsys.readouterr())
    assert codes == [0, 0, 1, 0, 0, 0], said
    logs = re.compile(r"logs/[^\s,]+")
    shown = [logs.sub("LOG", one.out).split() for one in said]
    assert shown[1:-1] == [output.split() for output in OUTPUTS]
    assert [one.err for one in said[1:3]] == ["", ""]


def test_json_is_for_programs(pair_log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(pair_log), "--json"]) == 0
    report = result_of(capsys.readouterr().out)
    assert (report["same"], report["compared"], report["first"]) == (True, 50, None)
    code = main(["replay", str(pair_log), "--json", "--set", "all_inputs.gain=0.5"])
    report = result_of(capsys.readouterr().out)
    assert (code, report["same"]) == (1, False)
    assert (report["first"]["cycle"], report["first"]["joint"]) == (0, "tilt")
    assert len(report["joints"]) == 2


def test_remarks_go_to_stderr(
    pair_log: Path, changed: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    log = changed(pair_log, versions(numpy="1.0"), no_commands(), put("active", 2, 0))
    assert main(["replay", str(log)]) == 1
    said = capsys.readouterr()
    assert said.out.splitlines() == [
        "pair: 1 of 10 replayed cycles differs",
        "first: cycle 2, 0.040 s, controller states: recorded not active, replayed active",
    ]
    version, gap = said.err.splitlines()
    assert version.startswith("pair: numpy has version 1.0 in the run and ")
    assert gap.startswith("pair: the log lacks a command of cycle 10")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["missing.mcap"], "log missing.mcap not found"),
        ([__file__], "this is a program in Python"),
        (["{log}", "fast"], "'fast' is not an argument of the robot file"),
        (["{log}", "--set", "neck.gain=1"], "the log has no such controller"),
        (["{log}", "--set", "all_inputs.gian=1"], "dxlrun: --set all_inputs has an unknown key 'gian'; did"),
        (["{log}", "rate:=100"], "change the loop's period"),
    ],
)
def test_wrong_words_are_one_sentence(
    pair_log: Path, arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", *(word.format(log=pair_log) for word in arguments)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert says in said.err
    assert len(said.err.splitlines()) == 1
