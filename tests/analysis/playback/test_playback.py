"""Recordings that `dxlrun replay --on` plays on a robot, and that `dxlrun convert` makes motion files of."""

import math
import os
import re
import signal
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from tests.kit.answers import result_of
from tests.kit.changed_logs import put, write_changed
from tests.kit.commands import cases, play

from dxlrun import ROTARY, InputError
from dxlrun.description.motion import read_motion as read_motion_file
from dxlrun.log.log_reader import Log, read_log
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan
from dxlrun.plan.robot_plan import Plan
from dxlrun_analysis.playback.motion_file import motion_file
from dxlrun_analysis.playback.recorded_motion import RecordedMotion
from dxlrun_analysis.playback.rows import PlaybackRows, rows_of
from dxlrun_analysis.playback.sources import read_motion
from dxlrun_lab.commands import on_robot
from dxlrun_lab.guided import virtual_rig

pytestmark = pytest.mark.long


Dxlrun = Callable[..., Any]


def played(words: Mapping[str, Any]) -> Log:
    return read_log(str(words["log"]))


def goals(log: Log, joint: str) -> tuple[np.ndarray, np.ndarray]:
    """Return times, s, and goals of a joint."""
    row = log.joints.index(joint)
    cycles = log.cycles
    return (cycles["scheduled_ns"] - cycles["scheduled_ns"][0]) * 1e-9, cycles["goal_position"][:, row]


def test_the_recorded_goals_are_sent_again(swing, place, dxlrun):
    """Behind the first 0.3 s, in which the motion becomes as fast as it was recorded."""
    done = dxlrun("replay", swing, "--on", "pair.yaml", "--virtual", "--json")
    assert done.code == 0, done
    result = result_of(done.out)
    assert result["whole"]
    assert [one["name"] for one in result["joints"]] == ["pan", "tilt"]
    assert "first pose: pan (ID 1 on bus main) moves farthest, 0.0 deg, at up to" in done.err
    for joint in ("pan", "tilt"):
        time_s, sent = goals(read_log(swing), joint)
        again_s, again = goals(played(result), joint)
        best = min(
            np.abs(np.interp(time_s[60:-60] + shift, again_s, again) - sent[60:-60]).max()
            for shift in np.arange(0.0, 1.0, 0.01)
        )
        assert best < np.radians(0.2), joint


def test_half_the_speed_a_stretch_and_other_joints(swing, place, dxlrun):
    words = "--from 1 --to 2 --speed 0.5 --map pan=tilt --map tilt= --json --virtual"
    done = dxlrun("replay", swing, "--on", "pair.yaml", *words.split())
    assert done.code == 0, done
    result = result_of(done.out)
    assert result["seconds"] == pytest.approx(2.0 + 0.3 + 0.5, abs=0.05)  # the ramps, and the pose at the end
    time_s, sent = goals(read_log(swing), "pan")
    _, again = goals(played(result), "tilt")
    inside = (time_s >= 1.0) & (time_s <= 2.0)
    assert again.max() == pytest.approx(sent[inside].max(), abs=np.radians(0.2))
    assert again[-1] == pytest.approx(sent[inside][-1], abs=np.radians(0.2))
    _, still = goals(played(result), "pan")
    assert np.ptp(still) < 1e-6


@pytest.mark.parametrize("case", cases(Path(__file__).with_name("refusals.txt")))
def test_refused(place, dxlrun, case):
    play(case, dxlrun)


def refused(dxlrun: Dxlrun, *words: object) -> list[str]:
    done = dxlrun("replay", *words)
    assert (done.code, done.out) == (2, ""), done
    return [str(line) for line in done.err.splitlines()]


def test_a_speed_that_is_slow_enough_is_named(swing, place, dxlrun):
    slow = (place / "pair.yaml").read_text().replace("60 deg]}", "60 deg], velocity: 1 rad/s}")
    (place / "slow.yaml").write_text(slow)
    _, fix = refused(dxlrun, swing, "--on", "slow.yaml")
    enough = float(fix.split("--speed ")[1].split()[0])
    assert 0.6 < enough < 0.75  # 1 / (0.4 * 4), and what the tolerance allows
    assert refused(dxlrun, swing, "--on", "slow.yaml", "--speed", enough + 0.01)
    assert dxlrun("replay", swing, "--on", "slow.yaml", "--speed", enough, "--virtual").code == 0


def test_real_joints_are_asked_about_before_a_run_is_started(swing, place, dxlrun, monkeypatch):
    real = (place / "pair.yaml").read_text().replace("port: sim", "port: /dev/ttyUSB0")
    (place / "real.yaml").write_text(real.replace("2.0,", "2.0, adapter: {latency: 1 ms},"))
    with open(os.devnull) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        done = dxlrun("replay", swing, "--on", "real.yaml")
    assert (done.code, done.out) == (2, "")
    assert (
        f"2 joints will move to the first pose at up to 29 deg/s, and then play 4.5 s of {swing}; "
        in done.err
    )
    assert "46 deg; fastest: pan, 9" in done.err
    assert "pair will start now and enable torque as in its file" in done.err
    assert "(nothing was moved); add --yes" in done.err


def test_joints_are_led_slowly_to_a_first_pose_that_is_far(swing, place, dxlrun):
    time_s, sent = goals(read_log(swing), "tilt")
    widest = int(np.abs(sent).argmax())
    done = dxlrun("replay", swing, "--on", "pair.yaml", "--virtual", "--json", "--from", time_s[widest])
    assert done.code == 0, done
    assert "first pose: tilt (ID 2 on bus main) moves farthest, 34.3 deg, at up to 29 deg/s" in done.err
    _, again = goals(played(result_of(done.out)), "tilt")
    there = int(np.argmax(np.abs(again - sent[widest]) < np.radians(0.15)))
    speed = np.abs(again[10 : there + 1] - again[: there - 9]) / 0.1  # a row of that way lasts two cycles
    assert there > 80
    assert np.degrees(speed.max()) == pytest.approx(29, abs=0.6)


@pytest.mark.parametrize("cycle", [60, 230], ids=["on the way to the first pose", "in the motion"])
def test_a_joint_that_is_lost_ends_it_and_the_others_stay(swing, place, dxlrun, monkeypatch, cycle):
    usual = virtual_rig.VirtualLink

    def losing(plan: Plan, **more: Any) -> object:
        def lose(number: int) -> None:
            if number == cycle:
                robot.simulated.buses[0].servo(2).silence(True)

        robot = usual(plan, **{**more, "each_cycle": lose})
        return robot

    monkeypatch.setattr(virtual_rig, "VirtualLink", losing)
    done = dxlrun("replay", swing, "--on", "pair.yaml", "--virtual", "--json", "--from", "2")
    assert done.code == 1
    result = result_of(done.out)
    assert (result["whole"], result["why"]) == (False, "joint tilt (ID 2 on bus main) is lost")
    sent = np.stack([goals(played(result), joint)[1] for joint in ("pan", "tilt")])
    assert np.ptp(sent[:, cycle - 10 : cycle], axis=1).max() > np.radians(0.5)
    assert np.ptp(sent[:, cycle + 8 :], axis=1).max() < np.radians(0.01)


def motion(position: np.ndarray, seconds: float) -> RecordedMotion:
    times = np.linspace(0.0, seconds, len(position))
    return RecordedMotion(Path("a.mcap"), ("pan",), ("states",), times, position[:, None], 0.0, (ROTARY,))


def rows(position: np.ndarray, seconds: float = 2.0, **limits: Any) -> PlaybackRows:
    plan = JointPlan("pan", **{"lower": -1.0, "upper": 1.0, "velocity": 5.0, **limits})
    return rows_of(motion(position, seconds), {"pan": plan}, speed=1.0, tolerance=0.01, period_s=0.01)


def test_a_position_limit_is_kept_within_the_tolerance():
    """A servo that was measured a little beyond its limit is sent no farther than that."""
    wave = np.sin(np.linspace(0, 6, 200))
    assert np.abs(rows(1.009 * wave).positions).max() == 1.0
    with pytest.raises(InputError, match=r"pan is at .*, beyond its limits of -57.3 to 57.3 deg"):
        rows(1.03 * np.maximum(wave, 0.0))
    with pytest.raises(InputError, match=r"pan is at -59.01 deg, beyond its limits of -57.3 to 57.3 deg"):
        rows(1.03 * np.minimum(wave, 0.0))
    assert np.abs(rows(3 * wave, bounded=False, velocity=20.0).positions).max() == pytest.approx(
        3.0, abs=0.02
    )


def test_speed_and_acceleration_limits_hold_where_they_are_reached():
    wave = 0.5 * np.sin(np.linspace(0, 8, 400))  # of 2 s: 2 rad/s, 8 rad/s^2
    assert rows(wave, velocity=2.2, acceleration=11.0).duration_s == pytest.approx(2.3, abs=0.02)
    with pytest.raises(InputError, match=r"rad/s, more than its 1.7 rad/s") as found:
        rows(wave, velocity=1.7, acceleration=3.0)
    assert "more than its 3 rad/s^2" in str(found.value)
    with pytest.raises(InputError, match=r"rad/s, more than its 1.5 rad/s"):
        rows(wave, top_speed=1.5)


@pytest.mark.parametrize("seconds", [0.01, 0.02, 0.04, 0.1])
def test_a_jump_is_refused_however_short_the_motion_is(seconds):
    with pytest.raises(InputError, match=r"pan moves at .* rad/s, more than its 5 rad/s") as found:
        rows(np.array([-0.5, -0.5, 0.5, 0.5]), seconds, acceleration=100.0)
    assert "at speed" not in str(found.value)
    assert "more than its 100 rad/s^2" in str(found.value)
    assert rows(np.array([-0.01, 0.01]), seconds).duration_s == pytest.approx(2 * seconds, abs=0.011)


def test_a_long_motion_has_fewer_rows_and_one_that_is_too_long_is_refused():
    still = np.zeros(2000)
    assert rows(still, 8000.0).period_s == pytest.approx(0.02)
    with pytest.raises(InputError, match="11000 s of 1 joints are too long to play at once, at most 10000 s"):
        rows(still, 11000.0)


def test_a_state_that_is_not_valid_is_no_position(swing, tmp_path):
    """A position beside a lost reply is the one before it; a loss of more than 1 s is no motion."""
    pan, tilt = (read_log(swing).joints.index(joint) for joint in ("pan", "tilt"))
    lost = (put("valid", (slice(50, 81), pan), False), put("valid", (slice(120, 251), tilt), False))
    write_changed(swing, tmp_path / "lost.mcap", *lost)
    usual = read_motion(swing, what="states", only=["pan"])
    found = read_motion(tmp_path / "lost.mcap", what="states", only=["pan"])
    gone = (usual.time_s > 0.495) & (usual.time_s < 0.805)
    assert found.time_s.tolist() == usual.time_s[~gone].tolist()
    assert found.position.tolist() == usual.position[~gone].tolist()
    with pytest.raises(InputError, match=r"no positions of tilt from 1\.19\d* s to 2\.51\d* s"):
        read_motion(tmp_path / "lost.mcap", what="states")


def test_way_to_a_goal_with_a_speed_is_played(swing, tmp_path):
    pan = read_log(swing).joints.index("pan")
    log = write_changed(swing, tmp_path / "fast.mcap", put("command_velocity", (slice(None), pan), 3.0))
    assert read_motion(log).what == ("states", "goals")


def test_ctrl_c_brings_the_joints_to_rest_and_ends_the_run(swing, place, dxlrun, monkeypatch):
    def interrupt(*_: object) -> None:
        threading.Timer(0.67, os.kill, (os.getpid(), signal.SIGINT)).start()

    monkeypatch.setattr(on_robot, "_show", interrupt)  # when the motion begins
    done = dxlrun("replay", swing, "--on", "pair.yaml", "--speed", 0.01, "--virtual")
    assert done.code == 130, done
    assert "pair: the motion ended early: aborted by Ctrl-C" in done.err
    (path,) = place.glob("logs/*.mcap")
    log = read_log(path)
    assert log.complete
    assert np.abs(np.diff(log.cycles["goal_position"][-10:], axis=0)).max() < 1e-3


@pytest.mark.parametrize(("degrees", "most_points"), [(0.02, 120), (2.0, 16)])
def test_what_it_plays_is_within_the_tolerance(swing, place, dxlrun, degrees, most_points):
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


def test_the_file_says_where_it_comes_from_and_is_never_written_over(swing, place, dxlrun):
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


def test_controllers_of_single_positions_get_them_every_20_ms(tmp_path):
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


def test_another_controller_and_other_joints(swing, place, dxlrun):
    words = ["--joint", "pan", "--map", "pan=elbow", "--controller", "arm"]
    assert dxlrun("convert", swing, "a.yaml", *words).code == 0
    (part,) = read_motion_file(place / "a.yaml").motion.motions
    assert part.controller == "arm"
    assert set(part.points[0].joints) == {"elbow"}  # type: ignore[union-attr]  # of points
