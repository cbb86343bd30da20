"""`dxlrun teach`: a scripted hand shows a motion to a robot that runs."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.hands import LiveRobot, Script, interrupt, written

from dxlrun import RemoteRobot, connect
from dxlrun.description.motion import MotionForm, read_motion
from dxlrun.errors import InputError, Refused, ServoFault
from dxlrun_hand.teaching import Teaching, taught

pytestmark = pytest.mark.long

ROBOT = """\
name: arm
arguments: {port: {default: sim, help: port}}
buses:
  main: {port: "${port}", protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 0 ms}}
loop: {rate: 50, scheduler: {policy: round_robin, priority: 31}}
joint_defaults: {bus: main, reference: 180 deg}
groups: {hand: {joints: [wrist]}}
joints:
  elbow: {id: 5, model: XL430-W250, direction: 1, limits: {position: [-60 deg, 60 deg]}}
  wrist: {id: 2, model: XM430-W350, direction: -1}
controllers:
  arm: {type: joint_trajectory_controller, command_interface: position, joints: [elbow]}
  grip: {type: joint_group_position_controller, joints: [wrist]}
"""
POSE, RECORD, DONE = "", "r", "s"
SPEED = math.radians(60)


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveRobot]:
    directory = tmp_path_factory.mktemp("live")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(directory))
        with LiveRobot(directory, written(directory, ROBOT)) as live:
            yield live


def enable_torque(robot: RemoteRobot) -> bool:
    """Enable torque of all joints. Returns False where one does not answer at this moment."""
    try:
        robot.torque("all", True)
    except Refused as refused:
        if refused.code != "joint_lost":
            raise
        return False
    return True


@pytest.fixture
def robot(live: LiveRobot) -> Iterator[RemoteRobot]:
    """The robot as it is after its start; on a busy machine servos may be lost for some cycles."""
    live.restart()
    with connect() as robot:
        yield robot
        live.until(lambda: enable_torque(robot))
        robot.switch([one["name"] for one in robot.info()["controllers"] if not one["active"]])


def after(live: LiveRobot, answer: str, **turns: float) -> Callable[..., str]:
    """Return what turns servos, and types something then."""

    def turn(look: Callable[[], object] = lambda: None) -> str:
        live.turn(look, 0.4, **turns)
        return answer

    return turn


def positions(robot: RemoteRobot) -> dict[str, float]:
    """Return where the joints are, degrees."""
    states = robot.states()
    return dict(zip(states.joints, np.degrees(states.position).tolist(), strict=True))


def points(motion: MotionForm) -> dict[str, list[tuple[float, float]]]:
    """Return the points of each joint, s and degrees."""
    return {
        name: [(point.time * 1e-9, math.degrees(point.joints[name].position)) for point in part.points]
        for part in motion.motions
        for name in part.points[0].joints
    }


def test_poses_and_a_recorded_motion_are_saved_and_played(
    live: LiveRobot, robot: RemoteRobot, tmp_path: Path
) -> None:
    before, target = positions(robot), tmp_path / "wave.yaml"
    script = Script(
        ("These joints become limp: elbow, wrist.", ""),
        ("0 taught", after(live, POSE, id5=30, id2=-20)),
        ("1 taught", after(live, "hold elbow")),
        ("1 taught", after(live, "limp elbow hand")),
        ("1 taught", after(live, POSE, id5=-10, id2=10)),
        ("2 taught", "u"),
        ("1 taught", RECORD),
        ("Recording", after(live, "", id5=-40, id2=30)),
        ("2 taught", DONE),
        ("The torque will be switched on", after(live, "")),
        ("Play the motion on arm? It starts slowly.", "y"),
    )
    assert taught(robot, script, (), target, SPEED) == 0
    motion = read_motion(target).motion
    assert [part.controller for part in motion.motions] == ["arm", "grip"]
    ends = {"elbow": (30, -20), "wrist": (20, -20)}
    for joint, path in points(motion).items():
        begin, end = (before[joint] + way for way in ends[joint])
        assert (path[0][1], path[-1][1]) == (pytest.approx(begin, abs=1.5), pytest.approx(end, abs=1.5))
        assert 1.0 < path[-1][0] < 3.5
        assert positions(robot)[joint] == pytest.approx(end, abs=2.0)
    assert "goal 1 of arm reached" in script.text
    assert {one["name"] for one in robot.info()["controllers"] if one["active"]} == {"arm", "grip"}


def test_a_joint_beyond_its_limits_is_kept_at_them(
    live: LiveRobot, robot: RemoteRobot, tmp_path: Path
) -> None:
    target, there = tmp_path / "far.yaml", positions(robot)["elbow"]
    script = Script(
        ("These joints become limp: elbow.", ""),
        ("0 taught", after(live, POSE, id5=70 - there)),
        ("1 taught", "hold elbow"),
        ("1 taught", DONE),
        ("The torque will be switched on", ""),
        ("The torque will be switched on", after(live, "", id5=-50)),
        ("Play", ""),
    )
    assert taught(robot, script, ("arm",), target, SPEED) == 0
    assert points(read_motion(target).motion)["elbow"][-1][1] == pytest.approx(60.0, abs=0.1)
    assert "elbow was moved beyond its limits; the motion stops at the limits" in script.text
    assert script.text.count("outside its limits") == 2


def test_giving_up_saves_nothing_and_gives_the_torque_back(robot: RemoteRobot, tmp_path: Path) -> None:
    asked = (("0 taught", DONE), ("0 taught", "limp x"), ("0 taught", "q"))
    steps = (("become limp", ""), *asked, ("be switched on", ""))
    script = Script(*steps)
    assert taught(robot, script, ("hand",), tmp_path / "none.yaml", SPEED) == 1
    assert script.said[-1] == "Nothing was saved."
    assert "no joint or group x; choose from all, arm, grip, hand, elbow, wrist" in script.text
    assert "nothing was taught yet" in script.text
    assert set(robot.states().torque) == {"on"}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("at", "limp"), [("become limp", False), ("0 taught", True), ("be switched on", True), ("Play", False)]
)
def test_after_ctrl_c_it_is_said_what_is_limp(
    robot: RemoteRobot, tmp_path: Path, at: str, limp: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    steps = [("become limp", ""), ("0 taught", ""), ("1 taught", "s"), ("be switched on", ""), ("Play", "y")]
    with pytest.raises(KeyboardInterrupt):
        taught(
            robot,
            Script(*((s, interrupt if s == at else a) for s, a in steps)),
            ("elbow",),
            tmp_path / "a.yaml",
            1,
        )
    left = "still limp: elbow (`dxlrun torque on elbow`); "
    left += "still deactivated: arm (`dxlrun switch --activate arm`)\n"
    assert capsys.readouterr().err == (left if limp else "")
    assert (robot.states().joint("elbow")["torque"] != "on") is limp
    assert (tmp_path / "a.yaml").exists() is (at in ("be switched on", "Play"))


def test_a_refusal_that_deactivated_a_controller_names_it(
    robot: RemoteRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """So it is refused where a servo does not answer: its torque goes off when it is back."""
    switch = RemoteRobot.torque

    def refuse(robot: RemoteRobot, joints: list[str], on: bool, *, release: bool = False) -> None:
        switch(robot, joints, on, release=release)
        raise Refused("elbow does not answer")

    monkeypatch.setattr(RemoteRobot, "torque", refuse)
    with pytest.raises(Refused):
        taught(robot, Script(("become limp", "")), ("elbow",), tmp_path / "a.yaml", SPEED)
    assert "still deactivated: arm (`dxlrun switch --activate arm`)" in capsys.readouterr().err


def test_a_servo_that_falls_silent_ends_it(
    robot: RemoteRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def silent(look: Callable[[], object]) -> None:
        states = robot.states()
        old = replace(states, age_ns=states.age_ns + 1_100_000_000)
        monkeypatch.setattr(RemoteRobot, "states", lambda _: old)
        look()

    script = Script(("become limp", ""), ("0 taught", silent))
    with pytest.raises(ServoFault, match="elbow no longer answers; nothing was"):
        taught(robot, script, ("elbow",), tmp_path / "a.yaml", SPEED)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_taught_is_refused(robot: RemoteRobot) -> None:
    with pytest.raises(InputError, match="arm has no joint elbo; did you mean elbow"):
        Teaching(robot, Script(), ("elbo",), SPEED)
    robot.switch(deactivate=["grip"])
    with pytest.raises(InputError, match="no active controller of arm plays motions for wrist"):
        Teaching(robot, Script(), ("wrist",), SPEED)
    robot.switch(deactivate=["arm"])
    with pytest.raises(InputError, match="no active controller of arm plays motions; activate one with"):
        Teaching(robot, Script(), (), SPEED)
