"""Torque, reboots and registers that clients request of the loop: refused, released, answered."""

import numpy as np
import pytest
from tests.kit.loops import Robot, commanding

from dxlrun.channels.answers import Acceptance, Code, Completion, Refusal
from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.plan.policy_plan import SLOW_SPEED
from dxlwire.modes import Mode

HOLD = commanding(position=0.1)


class Story(Robot):
    """A robot of three joints, of which `arm` commands two; what is asked of servos, the test answers."""

    def __init__(self, chain=False):
        super().__init__(joints=3)
        upper = {"joints": ("j0",), "command": ("position",), "into": ("arm",)}
        usual = {"joints": ("j2",), "active": False}
        self.script("arm", HOLD, joints=("j0", "j1"), reference=("position",) if chain else ())
        self.script("other", HOLD, **(upper if chain else usual))
        self.script("again", HOLD, joints=("j1",), active=False)
        self.asked = []

    def build(self, **plan):
        super().build(**plan)
        self.states = self.record.states
        self.states.torque[:] = Torque.ON
        for name in ("write_register", "switch_torque", "reboot_servo", "read_register"):
            setattr(self.hardware, name, lambda *words: self.asked.append(words))
        return self

    @property
    def what(self):
        """What was asked of servos, without a client to answer."""
        return [words[:-1] for words in self.asked]

    def done(self, *answer, which=0):
        """Return what answers for a servo."""
        return lambda: self.asked[which][-1](*(answer or ("",)))

    def torques(self, *joints, on=False, **more):
        return self.asks("torque", joints=list(joints), on=on, **more)

    def shows(self, row, **states):
        """Return what lets a joint show other states from a cycle on."""

        def change():
            for name, value in states.items():
                getattr(self.states, name)[row] = value

        return change

    def goals(self, row):
        return np.array([position[row] for position, _ in self.hardware.written])


@pytest.fixture
def story():
    return Story()


COMMANDED = (Code.JOINT_COMMANDED, {"joint": ("j1",), "controller": ("arm",)})


def test_a_free_joint_is_switched_and_answered_when_it_is_done(story):
    answers = []

    def look():
        answers.append(story.inbox.answers.get(1))

    story.run(6, {1: story.torques("j2"), 2: look, 3: story.done(), 4: look})
    assert story.what == [(2, False)]
    assert answers == [Acceptance(()), Completion(2)]
    assert story.events.texts(EventCode.STEERED) == ["torque off: j2 from anna"]


def test_a_joint_that_is_commanded_is_refused_without_release(story):
    story.run(4, {1: story.torques("j2", "j1")})
    assert story.asked == []
    assert story.answer() == COMMANDED
    assert story.refusals[1] == "j1 is commanded by arm; deactivate arm first, or add --release"
    assert story.active(3) == ["arm"]


@pytest.mark.parametrize(("kind", "data"), [("torque", {"on": False}), ("reboot", {})])
def test_release_deactivates_in_the_same_cycle(story, kind, data):
    story.run(5, {2: story.asks(kind, joints=["j1"], release=True, **data)})
    assert story.column("active") == [1, 1, 0, 0, 0]
    assert story.what == [(1, *data.values())]


def test_the_upper_ends_of_chains_are_released_too():
    story = Story(chain=True)
    story.run(5, {1: story.torques("j1"), 2: story.torques("j1", release=True)})
    assert story.answer()[1]["controller"] == ("other", "arm")
    assert story.column("active") == [3, 3, 0, 0, 0]


LIMP = {"joint": ("j2",), "servo": ("j2",), "hint": "switch torque on with `dxlrun torque on j2`"}


@pytest.mark.parametrize("torque", [Torque.ON, Torque.RELEASED, Torque.OFF])
def test_a_controller_is_not_activated_on_a_limp_joint(story, torque):
    """Also in the cycle that switches the torque off, when the states do not show it yet."""
    switch, off = story.switches(["other"]), story.torques("j2")
    at_once = torque is Torque.ON
    story.run(5, {1: [off, switch]} if at_once else {1: story.shows(2, torque=torque), 2: switch})
    assert story.answer(1 + at_once) == (Code.JOINT_LIMP, LIMP)
    assert story.refusals[1 + at_once] == "j2 is limp; switch torque on with `dxlrun torque on j2`"


def test_a_limp_joint_outside_its_limits_is_moved_inside_before_it_can_get_torque(story):
    def stand_outside():
        story.record.goals.position[2] = 4.0  # where the hardware of this test has it then

    limp = story.shows(2, torque=Torque.OFF)
    story.run(5, {1: [limp, stand_outside, story.switches(["other"])]})
    hint = "move j2 inside the limits by hand, then switch torque on with `dxlrun torque on j2`"
    assert story.answer() == (Code.JOINT_LIMP, {**LIMP, "hint": hint})


def test_a_controller_is_not_activated_while_one_of_its_joints_is_limp(story):
    story.script("both", HOLD, joints=("j1", "j2"), active=False)
    story.run(5, {1: story.shows(2, torque=Torque.OFF), 2: story.switches(["both"], ["arm"])})
    assert story.answer() == (Code.JOINT_LIMP, LIMP)
    assert story.active(4) == ["arm"]


def test_a_controller_is_activated_when_the_joint_has_torque_again(story):
    switch = story.switches(["other"])
    off = [story.done(), story.shows(2, torque=Torque.RELEASED)]
    at = {1: story.torques("j2"), 2: off, 3: story.torques("j2", on=True), 4: switch}
    story.run(9, at | {5: story.shows(2, torque=Torque.ON), 6: switch})
    codes = [one.code if isinstance(one, Refusal) else type(one) for one in story.inbox.answers.values()]
    # the run ended before the servo had its torque
    assert codes == [Completion, Code.RUN_ENDING, Code.JOINT_LIMP, Completion]


@pytest.mark.parametrize(
    ("kind", "data", "shown", "code"),
    [
        ("torque", {"on": True}, {"torque": Torque.LOST}, Code.JOINT_LOST),
        ("reboot", {}, {"torque": Torque.LOST}, Code.JOINT_LOST),
        ("torque", {"on": True}, {"hardware_error": 32, "torque": Torque.OFF}, Code.HARDWARE_ERROR),
        ("torque", {"on": True, "joints": ["j9"]}, {}, Code.UNKNOWN_JOINT),
        ("torque", {"on": True, "joints": []}, {}, Code.UNKNOWN_JOINT),
        ("torque", {"on": 1}, {}, Code.INVALID),
        ("torque", {}, {}, Code.INVALID),
        ("reboot", {"on": True}, {}, Code.INVALID),
    ],
)
def test_what_cannot_be_is_refused_for_all_joints(story, kind, data, shown, code):
    request = {"joints": ["j2", "j1"], "release": True} | data
    story.run(4, {1: story.shows(2, **shown), 2: story.asks(kind, **request)})
    assert story.answer()[0] is code
    assert story.asked == []
    assert story.column("active") == [1] * 4
    if code is Code.HARDWARE_ERROR:
        assert "find the cause, then `dxlrun reboot j2`" in story.refusals[1]


def test_what_went_wrong_with_one_of_several_is_the_answer(story):
    waits, why = [], "j1 (ID 2 on bus main) did not confirm torque off; dxlrun sends it again"

    def answer():
        story.done(which=0)()
        story.done(why, which=1)()
        waits.append(story.inbox.answers[1])
        story.done(which=2)()

    story.run(5, {1: story.torques("j0", "j1", "j2", release=True), 3: answer})
    assert waits == [Acceptance(())]
    assert story.answer() == (Code.TORQUE_NOT_SWITCHED, {"joint": ("j1",), "problem": why})


def test_a_request_in_a_pause_is_executed_and_one_at_the_end_refused(story):
    story.run(5, {1: story.asks("pause"), 2: story.torques("j2")})
    assert story.what == [(2, False)]
    assert story.answer(2) == (Code.RUN_ENDING, {})
    story.done()()  # too late: nothing more is answered
    assert story.answer(2) == (Code.RUN_ENDING, {})


# Registers

WRITE = {"joint": "j1", "item": "p_gain", "value": 40}


def test_a_register_is_answered_when_the_servo_has_it_and_not_before(story):
    write, read = story.asks("register", **WRITE), story.asks("get", joint="j1", item="p_gain")
    answers = []

    def settled():
        answers.append(dict(story.refusals))
        story.done("", 32, which=0)()
        story.done("", 40, which=1)()

    story.run(6, {1: [write, read], 4: settled})
    assert answers == [{}]
    assert story.what == [(1, "p_gain", 40), (1, "p_gain")]
    assert [story.answer(number) for number in (1, 2)] == [Completion(3, value=32), Completion(3, value=40)]
    assert story.events.texts(EventCode.STEERED)[0] == "register p_gain of j1 = 40 from anna"
    text = '{"joint":"j1","item":"p_gain","value":40}'
    assert (story.taken[0].cycle, story.taken[0].data_text) == (1, text)


@pytest.mark.parametrize(
    ("kind", "data", "code"),
    [
        ("register", WRITE, Code.REGISTER_NOT_WRITTEN),
        ("get", {"joint": "j1", "item": "x"}, Code.REGISTER_NOT_READ),
    ],
)
def test_what_went_wrong_with_a_register_is_the_answer(story, kind, data, code):
    story.run(4, {1: story.asks(kind, **data), 2: story.done("j1 did not answer", None)})
    assert story.answer() == (code, {"problem": "j1 did not answer"})


@pytest.mark.parametrize(
    ("other", "code", "said"),
    [
        ({"joint": "j9"}, Code.UNKNOWN_JOINT, "there is no joint j9"),
        ({"value": 1.5}, Code.INVALID, "Expected `int`, got `float` - at `$.value`"),
        ({"more": 1}, Code.INVALID, "Object contains unknown field `more`"),
    ],
)
def test_a_register_that_cannot_be_is_refused_at_once(story, other, code, said):
    story.run(3, {1: story.asks("register", **WRITE | other)})
    assert said in story.refusals[1]
    assert story.answer()[0] is code
    assert story.asked == []


# Lost and limp joints


@pytest.mark.parametrize(
    ("cycles", "happens", "lost", "invalid"),
    [
        (14, {2: Torque.REBOOTING}, False, 0),
        (14, {2: Torque.REBOOTING, 12: Torque.ON}, False, 0),
        (30, {2: Torque.REBOOTING, 12: Torque.ON, 15: Torque.LOST}, True, 15),
        (30, {2: Torque.REBOOTING, 12: Torque.LOST}, True, 18),  # given up
        (14, {2: Torque.LOST}, True, 12),  # it was not this that was requested
    ],
)
def test_a_servo_that_reboots_by_request_is_not_lost_and_one_that_stays_away_is(
    story, cycles, happens, lost, invalid
):
    """The policy for lost servos would hold its controllers, or end the run."""
    shown = {
        cycle: story.shows(2, torque=torque, valid=torque is Torque.ON, age_ns=10**9)
        for cycle, torque in happens.items()
    }
    story.run(cycles, {1: story.asks("reboot", joints=["j2"])} | shown)
    assert story.loop.manager._lost == ([2] if lost else [])
    assert story.result.invalid == (0, 0, invalid)


SLOW = SLOW_SPEED * 0.02 + 1e-9


def test_the_goal_of_a_limp_joint_follows_it_and_its_first_goals_with_torque_are_slow(story):
    """Moved by hand from 0.25 to 0.9 rad: with torque it holds there, and goes slowly from there on."""
    by_hand = [story.shows(2, torque=Torque.RELEASED, position=0.9), lambda: _let_lie(story)]
    torque = story.shows(2, torque=Torque.ON, position=0.95)
    story.run(12, {3: by_hand, 6: torque, 8: story.switches(["other"])})
    goals = story.goals(2)
    np.testing.assert_allclose(goals[:8], [0.25] * 3 + [0.9] * 3 + [0.95] * 2)
    assert (np.abs(np.diff(goals[7:])) < SLOW).all()
    assert goals[-1] < 0.95


def _let_lie(story):
    """Let joints be where they are put from now on."""
    story.hardware.read_states = lambda: None


def test_a_commanded_joint_that_gets_torque_begins_where_it_is(story):
    """Its controller goes on meanwhile, and nothing is said of commands that a limp joint cannot follow."""
    by_hand = [story.shows(1, torque=Torque.OFF, position=0.9), lambda: _let_lie(story)]
    story.run(12, {3: by_hand, 5: story.torques("j1", on=True), 8: story.shows(1, torque=Torque.ON)})
    goals = story.goals(1)
    assert story.what == [(1, True)]
    np.testing.assert_allclose(goals[3:8], 0.9)
    assert (np.abs(np.diff(goals[7:])) < SLOW).all()
    assert goals[-1] < 0.9
    assert not any(story.column("clamped", 1)[3:8])


@pytest.mark.parametrize("mode", [Mode.VELOCITY, Mode.EFFORT, Mode.PWM, Mode.UNKNOWN])
@pytest.mark.parametrize("release", [False, True])
def test_torque_on_deactivates_controllers_of_limp_joints_only_with_release(story, mode, release):
    limp = story.shows(1, torque=Torque.OFF, mode=mode)
    story.run(6, {2: [limp, story.torques("j2", "j1", on=True, release=release)]})
    assert story.what == [(2, True), (1, True)]
    assert story.column("active") == [1, 1] + [0 if release else 1] * 4


def test_torque_on_keeps_controllers_of_joints_with_torque(story):
    driven = story.shows(slice(None), mode=Mode.EFFORT)
    story.run(5, {2: [driven, story.torques("j0", "j1", "j2", on=True, release=True)]})
    assert story.what == [(0, True), (1, True), (2, True)]
    assert story.column("active") == [1] * 5


def test_controller_of_a_joint_that_is_given_torque_begins_again(story):
    limp, given = story.shows(1, torque=Torque.OFF), story.shows(1, torque=Torque.GIVEN)
    story.run(12, {3: limp, 5: given, 6: story.shows(1, torque=Torque.ON)})
    text = "restarted at the measured positions: j1 regained torque"
    assert story.events.texts(EventCode.POLICY) == [text]
    assert story.column("active") == [1] * 12


def test_joint_that_is_given_torque_holds_where_its_first_reply_finds_it(story):
    """Its controller holds the goal with which it begins; a reply that is missing is awaited."""
    begun = np.zeros(1)

    def hold(controller, step, *_):
        context = controller.context
        np.copyto(
            *((begun, context.goals.position) if step == "activate" else (context.commands.position, begun))
        )

    story.script("holds", hold, joints=("j2",), command=("position",)).build()
    story.hardware.follow_goals = lambda rows: story.shows(rows, torque=Torque.ON)()
    limp = [story.shows(2, torque=Torque.OFF), lambda: _let_lie(story)]
    given, back = story.shows(2, torque=Torque.GIVEN, valid=False), story.shows(2, position=0.9, valid=True)
    story.run(12, {3: limp, 5: given, 7: back})
    np.testing.assert_allclose(story.goals(2), [0.25] * 7 + [0.9] * 5)


@pytest.mark.parametrize("torque", [Torque.ON, Torque.OFF, Torque.RELEASED])
def test_a_fallback_does_not_take_over_a_limp_joint(story, torque):
    story.script("first", joints=("j2",), fallback="other")
    story.run(12, {1: story.shows(2, torque=torque), 3: story.breaks("first")})
    limp = torque is not Torque.ON
    why = "other cannot take over: j2 is limp; switch torque on with `dxlrun torque on j2`"
    assert story.events.texts(EventCode.COMMAND_REFUSED) == [why] * limp
    assert story.result.reason == ("fault" if limp else "stopped")
    assert ("first" in story.result.detail) is limp


def test_a_long_list_is_cut_in_the_sentence_and_whole_in_its_fields():
    joints = tuple(f"j{row}" for row in range(20))
    refusal = Refusal(Code.UNKNOWN_JOINT, {"joint": joints})
    assert refusal.text == "there is no joint j0, j1, j2, j3 and 16 more"
    assert refusal.fields["joint"] == joints
    assert Refusal(Code.UNKNOWN_JOINT, {"joint": joints[:5]}).text == "there is no joint j0, j1, j2, j3, j4"
