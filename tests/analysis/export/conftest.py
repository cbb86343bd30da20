"""Made-up logs of two joints, and the fixtures of exports: a run, and the command."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from tests.kit.commands import Said

from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.ring import RecordKind
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.schemas import LoggedController, LogHeader
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.testing import VirtualRobot, plan_of

ROBOTS = Path(__file__).parents[3] / "robots"
PERIOD_NS = 20_000_000
NAN = float("nan")
Row = tuple[int, Sequence[float], Sequence[float], Sequence[float]]
"""Number of a cycle, positions, goals of position, goals of velocity."""
ROWS: tuple[Row, ...] = (
    (0, (0.0, NAN), (NAN, NAN), (NAN, NAN)),
    (1, (0.1, 1.0), (NAN, 0.5), (2.0, NAN)),
    (4, (0.2, 1.1), (NAN, 0.6), (3.0, NAN)),
    (5, (0.3, 1.2), (NAN, NAN), (NAN, NAN)),
)
"""Cycles of two joints; those with the numbers 2 and 3 are missing."""
STILL = tuple((number, (0.1, 1.0), (0.1, 0.5), (NAN, NAN)) for number in range(3))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The log of a run of two arms with a motion; beside it a `split` one of the same run, in two parts."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    plan = plan_of(ROBOTS / "bioloid_torso.yaml", duration_s=1.6, play=[ROBOTS / "motions/three_parts.yaml"])
    VirtualRobot(plan, log=path).run()
    parts = structs.replace(plan, recording=RecordingPlan(split_ns=1_000_000_000))
    VirtualRobot(parts, log=path.with_name("split")).run()
    return path


@pytest.fixture
def export(dxlrun):
    """Run `dxlrun export LOG ... OUT --format TO` in this process; words from the first option on follow."""

    def run_export(*words: object) -> Said:
        texts = [str(word) for word in words]
        end = next((at for at, text in enumerate(texts) if text.startswith("--")), len(texts))
        return dxlrun("export", *texts[: end - 1], "--format", *texts[end - 1 :])

    return run_export


def made(
    path: Path,
    rows: Sequence[Row] = ROWS,
    skipped: Mapping[int, int] | None = None,
    period_ns: int = PERIOD_NS,
    *,
    robot: str = "pair",
    joints: tuple[str, str] = ("wheel", "arm"),
    silent: Mapping[int, int] | None = None,
) -> Path:
    """Write a log of two joints from rows; `silent` has the ages of the second joint's state, in periods."""
    log = LogWriter(
        path, LogHeader(robot, joints, ("main",), (LoggedController("both", joints, ()),), period_ns, 0)
    )
    for number, positions, goals, speeds in rows:
        record = CycleRecord(CycleLayout(joints, ["both"]))
        due = 10**9 + number * period_ns
        record.cycle, record.skipped = number, (skipped or {}).get(number, 0)
        record.scheduled_ns = record.woken_ns = record.read_ns = record.updated_ns = due
        record.written_ns = due
        record.states.position[:] = positions
        record.states.age_ns[:] = np.where(np.isfinite(positions), 0, -1)
        record.states.age_ns[1] += (silent or {}).get(number, 0) * period_ns
        record.states.valid[:] = record.states.age_ns == 0
        record.goals.position[:], record.goals.velocity[:] = goals, speeds
        log.write_record(RecordKind.CYCLE, record.raw)
    log.close()
    return path
