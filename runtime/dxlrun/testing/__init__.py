"""A robot in virtual time in three lines: for authors of plug-ins, and for dxlrun's own tests.

Helpers only for dxlrun's own tests belong in `tests/kit`.

from dxlrun.testing import simulated_robot

robot = simulated_robot("robots/bioloid_torso.yaml", duration_s=2.0) robot.run() assert
robot.record.states.valid.all()
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import invalidate_caches
from pathlib import Path
from tempfile import TemporaryDirectory

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.description.frames.tree import FrameTree
from dxlrun.description.robot import robot_form
from dxlrun.errors import InputError
from dxlrun.log.log_reader import Log, read_log
from dxlrun.plan.robot_plan import Plan
from dxlrun.run.virtual_run import VirtualRobot

__all__ = [
    "FrameTree",
    "Log",
    "VirtualRobot",
    "installed",
    "kinematics",
    "plan_of",
    "read_log",
    "simulated_robot",
]


def plan_of(
    robot: str | Path,
    *,
    arguments: Mapping[str, str] | None = None,
    play: Iterable[str | Path] = (),
    duration_s: float | None = None,
) -> Plan:
    """Compile a robot file with its arguments and motions; raises InputError with all problems."""
    duration_ns = None if duration_s is None else round(duration_s * 1e9)
    return compile_files(Path(robot), arguments or {}, list(play), duration_ns).plan


def simulated_robot(
    robot: str | Path,
    *,
    arguments: Mapping[str, str] | None = None,
    play: Iterable[str | Path] = (),
    duration_s: float | None = None,
    log: Path | None = None,
    kept: Path | None = None,
) -> VirtualRobot:
    """Return a robot with simulated servos in virtual time, ready to `run()`.

        robot = simulated_robot("robots/bioloid_torso.yaml", duration_s=0.5)
        assert robot.run().reason == "ended"
        print(robot.record.states.position)

    Without `duration_s`, the run ends with the motions; without motions, it has no end. The directory `kept`
    has the kept states of controllers, which are read and written; without it, they are discarded. Raises
    InputError with all problems of the files.
    """
    plan = plan_of(robot, arguments=arguments, play=play, duration_s=duration_s)
    return VirtualRobot(plan, log=log, kept=kept)


def kinematics(robot: str | Path, *, arguments: Mapping[str, str] | None = None) -> FrameTree:
    """Return the frames of a robot's URDF.

    `kinematics(file).pose("left_hand_link", "base_link", {"left_elbow_joint": 0.5})` is the pose of a link.
    Raises InputError with all problems of the file, or when it names no URDF.
    """
    plan = plan_of(robot, arguments=arguments)
    if plan.urdf is None or plan.frames is None:
        raise InputError(f"{robot} has no URDF and so no frames; write `model: {{urdf: ...}}`")
    return FrameTree.from_urdf(plan.urdf, plan.frames)


@contextmanager
def installed(project: str | Path) -> Iterator[None]:
    """Make a package visible to dxlrun while the block runs, as `pip install -e PROJECT` does.

    For tests of a section of the robot file without an installation. dxlrun reads name, version and entry
    points from `pyproject.toml`; the package is in `PROJECT/src`.

        with installed("plugins/lights"):
            plan = plan_of("plugins/lights/lights.yaml")
        print(plan.feature_plans["lights"])

    Args:
        project: Directory with `pyproject.toml`.
    """
    own = tomllib.loads((Path(project) / "pyproject.toml").read_text())["project"]
    name, version = own["name"], own["version"]
    with TemporaryDirectory() as site:
        info = Path(site) / f"{name.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        with (info / "entry_points.txt").open("w") as file:
            for group, points in own.get("entry-points", {}).items():
                print(
                    f"[{group}]", *(f"{key} = {value}" for key, value in points.items()), sep="\n", file=file
                )
        before = sys.path.copy()
        sys.path[:0] = [site, str(Path(project).absolute() / "src")]
        _look_for_packages()
        try:
            yield
        finally:
            sys.path[:] = before
            _look_for_packages()


def _look_for_packages() -> None:
    invalidate_caches()
    robot_form.cache_clear()
