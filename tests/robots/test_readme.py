"""The README's motion fits the README's robot."""

import re
from pathlib import Path

from dxlrun.compile import compile_files

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")


def test_the_motion_of_the_readme_fits_its_robot(tmp_path: Path):
    robot_text, motion_text = re.findall(r"^```yaml\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)
    robot, motion = tmp_path / "robot.yaml", tmp_path / "motion.yaml"
    robot.write_text(robot_text)
    motion.write_text(motion_text)

    compiled = compile_files(robot, {}, [motion])

    assert compiled.warnings == ()
    assert len(compiled.plan.loop.commands) == 300
