"""docs/tutorial/space.md, typed from top to bottom; its arm runs on virtual time."""

import re
import runpy
import shlex
from contextlib import nullcontext
from pathlib import Path

import pytest
from tests.kit.commands import Dxlrun
from tests.kit.pages import page_text, shows

from dxlrun.cli.steering import goals
from dxlrun.testing import plan_of
from dxlrun.tooling.runs import VirtualLink
from dxlrun_space import reach, space_robot

ROBOTS = Path(__file__).parents[2] / "robots"
NAME = "open_manipulator_x_space"
STEP = re.compile(r"^```(\w*)\n(.*?)^```$|^    dxlrun ([^\n]*)$", re.MULTILINE | re.DOTALL)


@pytest.mark.needs("report")
def test_page(dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robots").symlink_to(ROBOTS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(reach, "POSTURES", 500)
    robot = space_robot.SpaceRobot(NAME, VirtualLink(plan_of(ROBOTS / f"{NAME}.yaml")))
    monkeypatch.setattr(goals, "connect_robot", lambda *_: nullcontext(robot))
    monkeypatch.setattr(space_robot.dxlrun, "connect", lambda *_: robot)
    files = "".join(
        path.read_text() for path in (ROBOTS / f"{NAME}.yaml", *ROBOTS.glob("motions/op3_space*"))
    )
    printed = ""
    for language, text, line in STEP.findall(page_text("space.md")):
        if line and line != f"robots/{NAME}.yaml":
            said = dxlrun(*shlex.split(line))
            assert said.code == (2 if "x=0.5" in line else 0), said
            printed = said.err + said.out
        elif language == "python":
            Path("program.py").write_text(text)
            runpy.run_path("program.py")
        elif language == "yaml":
            assert all(one in files for one in text.splitlines())
        elif text:
            assert shows(text, printed), f"{text}\n{printed}"
    assert Path("reach.png").stat().st_size > 10_000
