"""`dxlrun convert LOG MOTION.yaml`: the motion file plays what was recorded; nothing is written over."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from tests.kit.answers import result_of

from dxlrun import ROTARY
from dxlrun.description.motion import read_motion as read_motion_file
from dxlrun.log.log_reader import Log, read_log
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun_analysis.playback.motion_file import motion_file
from dxlrun_analysis.playback.recorded_motion import RecordedMotion

pytestmark = pytest.mark.long

Dxlrun = Callable[..., Any]


def goals(log: Log, joint: str) -> tuple[np.ndarray, np.ndarray]:
    """Return times, s, and goals of a joint."""
    cycles = log.cycles
    column = cycles["goal_position"][:, log.joints.index(joint)]
    return (cycles["scheduled_ns"] - cycles["scheduled_ns"][0]) * 1e-9, column


@pytest.mark.parametrize(("degrees", "most_points"), [(0.02, 120), (2.0, 16)])
def test_what_it_plays_is_within_the_tolerance(
    swing: Path, place: Path, dxlrun: Dxlrun, degrees: float, most_points: int
) -> None:
    words = ["--tolerance", f"{degrees}deg", "--json"]
    result = result_of(dxlrun("convert", swing, "again.yaml", *words).out)
    assert result["points"].keys() == {"both"}
    assert 5 < result["points"]["both"] <= most_points
    assert dxlrun("pair.yaml", "--virtual", "--play", "again.yaml").code == 0
    (path,) = place.glob("logs/*.mcap")
    for joint in ("pan", "tilt"):
        time_s, sent = goals(read_log(swing), joint)
        again_s, again = goals(read_log(path), joint)
        # from 1 s on, one second after the file's start
        off = np.abs(np.interp(time_s + 1.0, again_s, again) - sent)
        assert off.max() <= np.radians(degrees) * 1.05, joint


def test_the_file_says_where_it_comes_from_and_is_never_written_over(
    swing: Path, place: Path, dxlrun: Dxlrun
) -> None:
    done = dxlrun("convert", swing, "2nd-try.yaml", "--from", "1.5", "--to", "2")
    assert re.fullmatch(
        rf"2nd-try.yaml: 0.5 s of {swing}, with a deviation of at most 0.1 deg: \d+ points for both\n",
        done.out,
    )
    text = (place / "2nd-try.yaml").read_text()
    assert text.startswith(
        f"# Motion of {swing}, 1.500 s to 2.000 s: goals of pan, tilt, with a deviation of at most 0.1 deg.\n"
        "# Written by `dxlrun convert`.\nname: motion_2nd_try\n"
    )
    again = dxlrun("convert", swing, "2nd-try.yaml")
    assert (again.code, (place / "2nd-try.yaml").read_text()) == (2, text)
    assert again.err == "dxlrun: 2nd-try.yaml cannot be written (it exists); choose another name\n"
    assert [each.name for each in place.iterdir() if "2nd" in each.name] == ["2nd-try.yaml"]


def test_controllers_of_single_positions_get_them_every_20_ms(tmp_path: Path) -> None:
    """A joint that becomes slow at the end gets a speed at which it still arrives."""
    time, zero = np.linspace(0.0, 2.0, 101), np.zeros(101)
    position = np.stack([1.5 * np.sin(time * np.pi / 4), zero, 0.3 * np.sin(time), zero], axis=1)
    joints = ("pan", "wheel", "tilt", "neck")
    motion = RecordedMotion(Path("log"), joints, ("states",) * 4, time, position, 0.0, (ROTARY,) * 4)
    head = ControllerPlan(
        name="head",
        type="joint_group_posvel_controller",
        distribution="",
        parameters="",
        joints=("pan", "wheel"),
        command=("position", "velocity"),
        publishes=(),
        active=True,
        every=1,
    )
    group = "joint_group_position_controller"
    tail = structs.replace(head, name="tail", type=group, joints=("tilt",), command=("position",))
    rests = structs.replace(tail, name="rests", joints=("neck",))
    speeds = dict.fromkeys(joints, math.inf) | {"wheel": 0.2}
    allowed, file, plans = np.full(4, math.radians(0.5)), tmp_path / "slow.yaml", [head, tail, rests]
    file.write_text(motion_file(motion, allowed, file, None, "", plans=plans, speeds=speeds).text)
    parts = {part.controller: part.points for part in read_motion_file(file).motion.motions}
    assert [point.time for point in parts.pop("rests")] == [1_000_000_000, 3_000_000_000]
    for points in parts.values():
        assert points[0].time == 1_000_000_000
        assert np.diff([point.time for point in points]).min() == pytest.approx(20_000_000, abs=1_000_000)
    assert {target.velocity for point in parts["tail"] for target in point.joints.values()} == {None}
    assert parts["head"][1].joints["pan"].velocity == pytest.approx(1.5 * np.pi / 4, rel=0.02)
    last = parts["head"][-1].joints
    assert (last["pan"].velocity, last["wheel"].velocity) == pytest.approx((0.5, 0.2))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a.mcap"], "a.mcap does not end in .yaml; give the name of a YAML file"),
        (["none/a.yaml"], "directory none not found"),
        (["a.yaml", "--joint", "pan"], "a motion file needs all joints of both; convert tilt too"),
        (
            ["a.yaml", "--joint", "pan", "--map", "pan=arm"],
            "no controller active at the start plays motions of",
        ),
        (["a.yaml", "--from", "70"], "no motion between --from and --to"),
        (["a.yaml", "--controller", "1: [", "--joint", "pan"], "a.yaml:"),
    ],
)
def test_wrong_words_are_refused_and_leave_nothing(
    swing: Path, place: Path, dxlrun: Dxlrun, words: list[str], said: str
) -> None:
    done = dxlrun("convert", swing, *words)
    assert (done.code, done.out) == (2, "")
    assert said in done.err
    assert {each.name for each in place.iterdir()} == {"pair.yaml"}


def test_another_controller_and_other_joints(swing: Path, place: Path, dxlrun: Dxlrun) -> None:
    words = ["--joint", "pan", "--map", "pan=elbow", "--controller", "arm"]
    assert dxlrun("convert", swing, "a.yaml", *words).code == 0
    (part,) = read_motion_file(place / "a.yaml").motion.motions
    assert part.controller == "arm"
    assert set(part.points[0].joints) == {"elbow"}  # type: ignore[union-attr]  # of points
