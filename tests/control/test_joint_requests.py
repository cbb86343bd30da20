"""Torque and reboots that clients request of the loop: refused, released, answered."""

import numpy as np
import pytest
from msgspec.structs import replace

from dxlrun.channels.answers import Code, Done, Refusal, Waiting
from dxlrun.channels.cycle import Torque
from dxlrun.channels.events import EventCode
from dxlrun.description.modes import Mode
from dxlrun.plan.policy_plan import SLOW_SPEED


class Servos:
    """Takes requests for joints; a test answers them."""

    def __init__(self, robot):
        self.robot = robot
        self.asked = []

    def switch_torque(self, row, on, done):
        self.asked.append((row, "on" if on else "off", done))

    def reboot(self, row, done):
        self.asked.append((row, "reboot", done))

    def read_register(self, row, item, done):
        self.asked.append((row, item, done))

    def answer(self, *problems):
        for (_, _, done), problem in zip(self.asked, problems, strict=True):
            done(problem)

    @property
    def what(self):
        return [(row, what) for row, what, _ in self.asked]


def hold(controller, step, time_ns, data):
    if step == "update":
        controller.context.commands.position[:] = 0.1


@pytest.fixture
def story(make_robot):
    """Run cycles of three joints, of which `arm` commands two; `at`: what happens before a cycle."""

    def run(cycles, at, prepare=lambda robot: None):
        robot = make_robot(joints=3)
        robot.script("arm", hold, joints=("j0", "j1"))
        robot.script("other", hold, joints=("j2",), active=False)
        robot.script("again", hold, joints=("j1",), active=False)
        prepare(robot)
        robot.build()
        robot.servos = Servos(robot)
        for name in ("switch_torque", "reboot", "read_register"):
            setattr(robot.hardware, name, getattr(robot.servos, name))

        def idle(deadline_ns):
            number = len(robot.sink.cycles)
            at.get(number, lambda _: None)(robot)
            if number == cycles - 1:
                robot.stop.request()

        robot.hardware.idle = idle
        robot.record.states.torque[:] = Torque.ON
        robot.result = robot.loop.run()
        return robot

    return run


def asks(kind, **data):
    def ask(robot):
        robot.number = robot.ask(kind, **data)

    return ask


def both(*steps):
    def do(robot):
        for step in steps:
            step(robot)

    return do


def test_a_free_joint_is_switched_and_answered_when_it_is_done(story):
    answers = []

    def look(robot):
        answers.append(robot.inbox.answers.get(robot.number))

    robot = story(
        6,
        {
            1: asks("torque", joints=["j2"], on=False),
            2: look,
            3: lambda robot: robot.servos.answer(""),
            4: look,
        },
    )
    assert robot.servos.what == [(2, "off")]
    assert answers == [Waiting(()), Done(2)]
    ((_, text),) = robot.events.of(EventCode.STEERED)
    assert text == 'torque {"joints":["j2"],"on":false} from anna'


def test_a_joint_that_is_commanded_is_refused_without_release(story):
    robot = story(4, {1: asks("torque", joints=["j2", "j1"], on=False)})
    assert robot.servos.asked == []
    assert robot.answer(robot.number) == (Code.JOINT_COMMANDED, {"joint": ("j1",), "controller": ("arm",)})
    assert robot.refusals[robot.number] == "j1: commanded by arm; deactivate that first, or add --release"
    assert robot.manager.active == ()  # at the end; it was active until then
    assert [text for _, text in robot.events.of(EventCode.CONTROLLER_DEACTIVATED)] == ["inactive"]


@pytest.mark.parametrize("kind", ["torque", "reboot"])
def test_release_deactivates_in_the_same_cycle(story, kind):
    data = {"on": False} if kind == "torque" else {}
    robot = story(5, {2: asks(kind, joints=["j1"], release=True, **data)})
    assert [cycle["active"] for cycle in robot.sink.cycles] == [1, 1, 0, 0, 0]
    assert robot.servos.what == [(1, "off" if kind == "torque" else "reboot")]


def test_the_upper_ends_of_chains_are_released_too(story):
    def chain(robot):
        plan = robot._controllers
        plan[0] = replace(plan[0], reference=("position",))
        plan[1] = replace(plan[1], joints=("j0",), command=("position",), into=("arm",), active=True)

    robot = story(4, {1: asks("torque", joints=["j1"], on=False)}, chain)
    assert robot.answer(robot.number)[1]["controller"] == ("other", "arm")
    robot = story(5, {2: asks("torque", joints=["j1"], on=False, release=True)}, chain)
    assert [cycle["active"] for cycle in robot.sink.cycles] == [3, 3, 0, 0, 0]


@pytest.mark.parametrize("torque", [Torque.ON, Torque.RELEASED, Torque.OFF])
def test_a_controller_is_not_activated_on_a_limp_joint(story, torque):
    """Also in the cycle that switches the torque off, when the states do not show it yet."""

    def limp(robot):
        robot.record.states.torque[2] = torque

    asked = both(limp, asks("torque", joints=["j2"], on=False)) if torque is Torque.ON else limp
    switch = asks("switch", activate=["other"], deactivate=[])
    robot = story(5, {1: asked, 2: switch} if torque is not Torque.ON else {1: both(asked, switch)})
    hint = "`dxlrun torque on j2` gives it"
    assert robot.answer(robot.number) == (
        Code.JOINT_LIMP,
        {"joint": ("j2",), "servo": ("j2",), "hint": hint},
    )
    assert robot.refusals[robot.number] == "j2 has no torque; `dxlrun torque on j2` gives it"


def test_a_controller_is_activated_when_the_joint_has_torque_again(story):
    def shown(torque):
        return lambda robot: robot.record.states.torque.__setitem__(2, torque)

    robot = story(
        9,
        {
            1: asks("torque", joints=["j2"], on=False),
            2: both(lambda robot: robot.servos.answer(""), shown(Torque.RELEASED)),
            3: asks("torque", joints=["j2"], on=True),
            4: asks("switch", activate=["other"], deactivate=[]),
            5: shown(Torque.ON),
            6: asks("switch", activate=["other"], deactivate=[]),
        },
    )
    codes = [one.code if isinstance(one, Refusal) else type(one) for one in robot.inbox.answers.values()]
    # the run ended before the servo had its torque
    assert codes == [Done, Code.RUN_ENDING, Code.JOINT_LIMP, Done]


@pytest.mark.parametrize(
    ("kind", "data", "change", "code"),
    [
        ("torque", {"on": True}, ("torque", Torque.LOST), Code.JOINT_LOST),
        ("reboot", {}, ("torque", Torque.LOST), Code.JOINT_LOST),
        ("torque", {"on": True}, ("hardware_error", 32), Code.HARDWARE_ERROR),
        ("torque", {"on": True, "joints": ["j9"]}, None, Code.UNKNOWN_JOINT),
        ("torque", {"on": True, "joints": []}, None, Code.UNKNOWN_JOINT),
        ("torque", {"on": 1}, None, Code.INVALID),
        ("torque", {}, None, Code.INVALID),
        ("reboot", {"on": True}, None, Code.INVALID),
    ],
)
def test_what_cannot_be_is_refused_for_all_joints(story, kind, data, change, code):
    def prepare(robot):
        if change:
            name, value = change
            getattr(robot.record.states, name)[2] = value
            if name == "hardware_error":
                robot.record.states.torque[2] = Torque.OFF

    robot = story(4, {1: prepare, 2: asks(kind, **({"joints": ["j2", "j1"], "release": True} | data))})
    assert robot.answer(robot.number)[0] is code
    assert robot.servos.asked == []
    assert [cycle["active"] for cycle in robot.sink.cycles] == [1] * 4


def test_the_error_says_what_helps(story):
    def broken(robot):
        robot.record.states.hardware_error[2] = 32
        robot.record.states.torque[2] = Torque.OFF

    robot = story(4, {1: both(broken, asks("torque", joints=["j2"], on=True))})
    assert "find the cause, then `dxlrun reboot j2`" in robot.refusals[robot.number]


def test_what_went_wrong_with_one_of_several_is_the_answer(story):
    waits = []

    def answer(robot):
        (_, _, first), (_, _, second), (_, _, third) = robot.servos.asked
        first("")
        second("j1 (ID 2 on bus main) did not confirm torque off; it is tried again")
        waits.append(robot.inbox.answers[robot.number])
        third("")

    robot = story(5, {1: asks("torque", joints=["j0", "j1", "j2"], on=False, release=True), 3: answer})
    assert waits == [Waiting(())]
    assert robot.answer(robot.number) == (
        Code.TORQUE_NOT_SWITCHED,
        {"joint": ("j1",), "problem": "j1 (ID 2 on bus main) did not confirm torque off; it is tried again"},
    )


def test_a_request_in_a_pause_is_executed_and_one_at_the_end_refused(story):
    robot = story(5, {1: asks("pause"), 2: asks("torque", joints=["j2"], on=False)})
    assert robot.servos.what == [(2, "off")]
    assert robot.answer(robot.number) == (Code.RUN_ENDING, {})
    robot.servos.answer("")  # too late: nothing more is answered
    assert robot.answer(robot.number) == (Code.RUN_ENDING, {})


def test_a_register_is_read(story):
    def answer(robot):
        ((row, item, done),) = robot.servos.asked
        assert (row, item) == (1, "p_gain")
        done("", 32)

    robot = story(5, {1: asks("get", joint="j1", item="p_gain"), 3: answer})
    assert robot.answer(robot.number) == Done(2, value=32)
    robot = story(4, {1: asks("get", joint="j1", item="x"), 2: lambda r: r.servos.asked[0][2]("no", None)})
    assert robot.answer(robot.number) == (Code.REGISTER_NOT_READ, {"problem": "no"})


def test_a_servo_that_reboots_by_request_is_not_lost_and_one_that_stays_away_is(story):
    """The policy for lost servos would hold its controllers, or end the run."""

    def away(torque):
        def leave(robot):
            robot.record.states.valid[2] = False
            robot.record.states.age_ns[2] = 10**9
            robot.record.states.torque[2] = torque

        return leave

    def back(robot):
        robot.record.states.valid[2] = True
        robot.record.states.torque[2] = Torque.ON

    def story_of(cycles, at):
        robot = story(cycles, {1: asks("reboot", joints=["j2"])} | at)
        return robot.loop._lost.rows, robot.result.invalid

    boots, lost = away(Torque.REBOOTING), away(Torque.LOST)
    assert story_of(14, {2: boots}) == (frozenset(), (0, 0, 0))
    assert story_of(14, {2: boots, 12: back}) == (frozenset(), (0, 0, 0))
    assert story_of(30, {2: boots, 12: back, 15: lost}) == ({2}, (0, 0, 15))
    assert story_of(30, {2: boots, 12: lost}) == ({2}, (0, 0, 18))  # given up
    assert story_of(14, {2: lost}) == ({2}, (0, 0, 12))  # it was not this that was requested


def test_the_goal_of_a_limp_joint_follows_it_and_its_first_goals_with_torque_are_slow(story):
    """Moved by hand from 0.25 to 0.9 rad: with torque it holds there, and goes slowly from there on."""

    def moved(robot):
        robot.record.states.torque[2] = Torque.RELEASED
        robot.hardware.read = lambda: None
        robot.record.states.position[2] = 0.9

    def torque(robot):
        robot.record.states.torque[2] = Torque.ON
        robot.record.states.position[2] = 0.95

    robot = story(12, {3: moved, 6: torque, 8: asks("switch", activate=["other"], deactivate=[])})
    goals = np.array([position[2] for position, _ in robot.hardware.written])
    np.testing.assert_allclose(goals[:3], 0.25)
    np.testing.assert_allclose(goals[3:6], 0.9)
    np.testing.assert_allclose(goals[6:8], 0.95)  # where it was when it got its torque
    assert (np.abs(np.diff(goals[7:])) < SLOW_SPEED * 0.02 + 1e-9).all()
    assert goals[-1] < 0.95


def test_a_commanded_joint_that_gets_torque_begins_where_it_is(story):
    """Its controller goes on meanwhile, and nothing is said of commands that a limp joint cannot follow."""

    def moved(robot):
        robot.record.states.torque[1] = Torque.OFF
        robot.hardware.read = lambda: None
        robot.record.states.position[1] = 0.9

    def torque(robot):
        assert robot.servos.what == [(1, "on")]
        robot.record.states.torque[1] = Torque.ON

    robot = story(12, {3: moved, 5: asks("torque", joints=["j1"], on=True), 8: torque})
    goals = np.array([position[1] for position, _ in robot.hardware.written])
    np.testing.assert_allclose(goals[3:8], 0.9)
    assert goals[8] == pytest.approx(0.9, abs=SLOW_SPEED * 0.02 + 1e-9)
    assert (np.abs(np.diff(goals[7:])) < SLOW_SPEED * 0.02 + 1e-9).all()
    assert goals[-1] < 0.9
    begun = [cycle["cycle"] for cycle in robot.sink.cycles if cycle["clamped"][1]]
    assert not set(begun) & set(range(3, 8))


@pytest.mark.parametrize("mode", [Mode.VELOCITY, Mode.EFFORT, Mode.PWM, Mode.UNKNOWN])
@pytest.mark.parametrize("release", [False, True])
def test_torque_is_refused_where_a_command_would_be_followed_at_once(story, mode, release):
    def limp(robot):
        robot.record.states.torque[1] = Torque.OFF
        robot.record.states.mode[1] = mode

    robot = story(6, {2: both(limp, asks("torque", joints=["j2", "j1"], on=True, release=release))})
    if release:
        assert robot.servos.what == [(2, "on"), (1, "on")]
        assert [cycle["active"] for cycle in robot.sink.cycles] == [1, 1, 0, 0, 0, 0]
    else:
        assert robot.servos.asked == []
        assert robot.answer(robot.number) == (
            Code.JOINT_COMMANDED,
            {"joint": ("j1",), "controller": ("arm",)},
        )


def test_joints_with_torque_are_no_reason_to_refuse_it(story):
    def driven(robot):
        robot.record.states.mode[:] = Mode.EFFORT

    robot = story(5, {2: both(driven, asks("torque", joints=["j0", "j1", "j2"], on=True))})
    assert robot.servos.what == [(0, "on"), (1, "on"), (2, "on")]


def fails(controller, step, time_ns, data):
    if step == "update" and time_ns > 50_000_000:
        raise RuntimeError("broken")


@pytest.mark.parametrize("torque", [Torque.ON, Torque.OFF, Torque.RELEASED])
def test_a_fallback_does_not_take_over_a_limp_joint(story, torque):
    def prepare(robot):
        robot.script("first", fails, joints=("j2",), fallback="other")

    def limp(robot):
        robot.record.states.torque[2] = torque

    robot = story(12, {1: limp}, prepare)
    refused = [text for _, text in robot.events.of(EventCode.COMMAND_REFUSED)]
    if torque is Torque.ON:
        assert refused == []
        assert robot.result.reason == "stopped"
    else:
        assert refused == ["other does not take over: j2 has no torque; `dxlrun torque on j2` gives it"]
        assert robot.result.reason == "fault"
        assert "first" in robot.result.detail


def test_a_long_list_is_cut_in_the_sentence_and_whole_in_its_fields():
    joints = tuple(f"j{row}" for row in range(20))
    refusal = Refusal(Code.UNKNOWN_JOINT, {"joint": joints})
    assert refusal.text == "there is no joint j0, j1, j2, j3 and 16 more"
    assert refusal.fields["joint"] == joints
    assert Refusal(Code.UNKNOWN_JOINT, {"joint": joints[:5]}).text == "there is no joint j0, j1, j2, j3, j4"
