"""The envelope of --json: every command that has the option answers in it, refused or not."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.answers import read_answer

from dxlrun.cli.app import build
from dxlrun.cli.verb_registry import GROUPS
from dxlrun.testing import simulated_robot

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
Dxlrun = Callable[..., Any]
SUCCESSFUL = {
    "analyze": "analyze run.mcap",
    "characterize": "characterize robots/single_joint.yaml joint --virtual --measure speed",
    "check": "check robots/single_joint.yaml",
    "convert": "convert run.mcap new.yaml --what states",
    "examples": "examples",
    "export": "export run.mcap cycles.csv --format csv",
    "frames": "frames robots/bioloid_torso.yaml",
    "import": "import pan.csv",
    "latency": "latency --count 100 --no-record",
    "models": "models AX-12A",
    "new-plugin": "new-plugin my_robotics",
    "plugins": "plugins",
    "replay": "replay run.mcap",
}
"""A command line of each command that needs neither a running robot nor a port."""
RUNNING = {"list", "watch", "play", "stop", *GROUPS["Robots that run"]}
ELSEWHERE = {
    "bench rate": "cli/test_bench.py",
    "doctor": "cli/test_doctor.py",
    "experiment tracking": "lab/tracking/test_command.py",
    "fleet": "fleet/test_fleet_runs.py",
    "identify": "lab/identify/test_command.py",
    "keys": "remote/test_network_run.py",
    "logs": "analysis/season/test_logs.py",
    "scan": "cli/test_scan.py",
    "servo": "cli/test_servo.py",
    "sim": "cli/test_sim.py",
    "upload": "analysis/season/test_store.py",
    **dict.fromkeys(RUNNING, "cli/test_steer.py"),
}
"""Where the answers of the others are read by `tests.kit.answers`."""


def _verbs() -> list[str]:
    app = build(listed=True)
    found = []
    for name in app.resolved_commands():
        inner = [each for each in app[name].resolved_commands() if not each.startswith("-")]
        for words in [(name, each) for each in inner] or [(name,)]:
            command = app[words[0]] if len(words) == 1 else app[words[0]][words[1]]
            if command.default_command is not None and not name.startswith("-"):
                options = command.assemble_argument_collection()
                found += [" ".join(words)] * any("--json" in each.names for each in options)
    return found


VERBS = _verbs()


def test_answer_of_every_command_is_read_by_a_test() -> None:
    assert sorted([*SUCCESSFUL, *ELSEWHERE]) == sorted(VERBS)
    for place in ELSEWHERE.values():
        text = (ROOT / "tests" / place).read_text()
        assert "tests.kit.answers" in text, place


@pytest.mark.parametrize("verb", VERBS)
def test_refusal_of_every_command_is_an_answer(dxlrun: Dxlrun, verb: str) -> None:
    said = dxlrun(*verb.split(), "--no-such-option", "--json")
    answer = read_answer(said.out)
    assert (said.code, said.err, answer.ok, answer.result) == (2, "", False, None)
    assert answer.errors[0].fix


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("answers")
    (place / "robots").symlink_to(ROOT / "robots")
    (place / "pan.csv").write_text("time,pan\n0,0\n1,0.5\n")
    simulated_robot(ROOT / "robots/single_joint.yaml", duration_s=0.5, log=place / "run.mcap").run()
    return place


@pytest.mark.parametrize("verb", SUCCESSFUL)
def test_success_is_an_answer(
    dxlrun: Dxlrun, place: Path, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    monkeypatch.chdir(place)
    said = dxlrun(*SUCCESSFUL[verb].split(), "--json")
    answer = read_answer(said.out)
    assert (said.code, answer.ok, said.out.count("\n")) == (0, True, 1), said
    assert answer.result is not None
