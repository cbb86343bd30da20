"""A log of a robot on virtual time, and logs that are made cycle by cycle."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.commands import Dxlrun

from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.ring import RecordKind
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.schemas import LoggedController, LogHeader
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.testing import VirtualRobot, plan_of, simulated_robot

ROBOTS = Path(__file__).parents[3] / "robots"
PERIOD_NS = 20_000_000


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a run of two arms with a motion."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    motion = ROBOTS / "motions" / "three_parts.yaml"
    simulated_robot(ROBOTS / "bioloid_torso.yaml", duration_s=1.6, play=[motion], log=path).run()
    return path


@pytest.fixture(scope="session")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run with a log in two parts."""
    path = tmp_path_factory.mktemp("split") / "run"
    motion = ROBOTS / "motions" / "three_parts.yaml"
    plan = plan_of(ROBOTS / "bioloid_torso.yaml", duration_s=1.6, play=[motion])
    VirtualRobot(replace(plan, recording=RecordingPlan(split_ns=1_000_000_000)), log=path).run()
    return path


Row = tuple[int, Sequence[float], Sequence[float], Sequence[float]]
"""Number of a cycle, positions, goals of position, goals of velocity."""


@pytest.fixture
def made(tmp_path: Path) -> Callable[..., Path]:
    """Write a log of two joints from rows."""

    def made(
        *rows: Row,
        period_ns: int = PERIOD_NS,
        shift_ns: int = 0,
        skipped: Mapping[int, int] = MappingProxyType({}),
    ) -> Path:
        joints = ("wheel", "arm")
        header = LogHeader("pair", joints, ("main",), (LoggedController("both", joints, ()),), period_ns, 0)
        path = tmp_path / "made.mcap"
        log = LogWriter(path, header)
        for number, positions, goals, speeds in rows:
            record = CycleRecord(CycleLayout(joints, ["both"]))
            due = 10**9 + number * period_ns + (shift_ns if number > rows[0][0] else 0)
            record.cycle, record.skipped = number, skipped.get(number, 0)
            record.scheduled_ns = record.woken_ns = record.read_ns = record.updated_ns = due
            record.written_ns = due
            record.states.position[:] = positions
            record.states.age_ns[:] = np.where(np.isfinite(positions), 0, -1)
            record.goals.position[:] = goals
            record.goals.velocity[:] = speeds
            log.write_record(RecordKind.CYCLE, record.raw)
        log.close()
        return path

    return made


@pytest.fixture
def export(dxlrun: Dxlrun) -> Callable[..., tuple[int, str, list[str]]]:
    """Run `dxlrun export` in this process; gives exit code, output and errors."""

    def export(*words: object) -> tuple[int, str, list[str]]:
        said = dxlrun("export", *words)
        return said.code, said.out, said.errors

    return export
