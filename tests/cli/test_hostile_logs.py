"""Logs are what people send each other: no verb executes what is in one, or leaves its own folder for it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.changed_logs import plan, write_changed

from dxlrun.cli import main
from dxlrun.testing import simulated_robot

ROBOT = """\
name: short
loop: {rate: 50}
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
joint_defaults: {bus: main, model: XM430-W350, reference: 180 deg, direction: 1}
joints: {pan: {id: 1}, tilt: {id: 2}}
controllers:
  head: {type: ./still.py:Still, joints: [pan, tilt]}
"""
STILL = """\
from pathlib import Path

from dxlrun import Angle, Floats, JointController


class Still(JointController):
    offset: Angle = 0.0

    def positions(self, time: float, dt: float) -> Floats:
        return self.start + self.offset
"""
ATTACK = "\nPath('executed').write_text('')\n"
READERS = """\
analyze bad.mcap
analyze bad.mcap --json
analyze bad.mcap --report page.html
logs .
export bad.mcap rows.csv --format csv
export bad.mcap tables --format parquet
convert bad.mcap motion.yaml"""
REPLAYS = """\
replay bad.mcap
replay bad.mcap --code current
replay bad.mcap --set head.offset=0.1
replay bad.mcap x:=1"""
CODE = {
    "other code": ("still.py", STILL + ATTACK),
    "code above the folder": ("../" * 9 + "above.py", ATTACK),
    "code at a place of its own": ("OUTSIDE/new.py", ATTACK),
    "code that is not used": ("more.py", ATTACK),
}
"""Names and texts of files that a log claims to have"""
TEXTS = {
    "a file of another folder": ("name: short", "include: [OUTSIDE/foreign.yaml]\nname: short"),
    "a URDF of another folder": ("name: short", "model: {urdf: OUTSIDE/foreign.yaml}\nname: short"),
    "a motor of another folder": ("{id: 1}", "{id: 1, motor: OUTSIDE/foreign.yaml}"),
}
"""Changes of the robot file in a log"""


def edit(attack: str, outside: Path) -> Callable[[Any], None]:
    """Return what makes the plan in a log hostile."""
    old, new = (word.replace("OUTSIDE", str(outside)) for word in (CODE | TEXTS)[attack])

    def change(content: Any) -> None:
        if attack in CODE:
            content["included"][old] = new
        else:
            assert old in content["source_text"]
            content["source_text"] = content["source_text"].replace(old, new)

    return change


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("honest")
    (folder / "still.py").write_text(STILL)
    (folder / "good.yaml").write_text(ROBOT)
    simulated_robot(folder / "good.yaml", duration_s=0.3, log=folder / "run.mcap").run()
    return folder


@pytest.mark.parametrize("attack", [*CODE, *TEXTS])
def test_no_verb_executes_a_log_or_leaves_its_folder(
    honest: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    attack: str,
) -> None:
    outside, work = tmp_path / "outside", tmp_path / "work"
    outside.mkdir()
    work.mkdir()
    (outside / "foreign.yaml").write_text("a_word_of_nobody_else: 1\n")
    for name in ("still.py", "good.yaml"):
        (work / name).write_text((honest / name).read_text())
    monkeypatch.chdir(work)
    write_changed(honest / "run.mcap", work / "bad.mcap", plan(edit(attack, outside)))
    before = set(tmp_path.rglob("*"))
    for line in (READERS * (attack == "other code") + "\n" + REPLAYS).strip().splitlines():
        code = main(line.split())
        said = "".join(capfd.readouterr())
        assert code in {0, 1, 2}, (line, said)
        assert "Traceback" not in said, (line, said)
        assert "a_word_of_nobody_else" not in said, (line, said)
        assert not (work / "executed").exists(), (line, said)
    assert all(path.is_relative_to(work) for path in set(tmp_path.rglob("*")) - before)
    assert sorted(path.name for path in outside.iterdir()) == ["foreign.yaml"]
