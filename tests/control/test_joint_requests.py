"""Torque, reboots and registers that clients request, where a test answers for the servos."""

import numpy as np
import pytest
from tests.kit.loops import Robot, commanding

from dxlrun.channels.answers import Code, Refusal
from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.plan.policy_plan import SLOW_SPEED

HOLD = commanding(position=0.1)
SLOW = SLOW_SPEED * 0.02 + 1e-9


class Story(Robot):
    """A robot of three joints, of which `arm` commands two; what is asked of servos, the test answers."""

    def __init__(self):
        super().__init__(joints=3)
        self.script("arm", HOLD, joints=("j0", "j1")).script("other", HOLD, joints=("j2",), active=False)
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

    def torques(self, *joints, on=False, **more):
        return self.asks("torque", joints=list(joints), on=on, **more)

    def shows(self, row, **states):
        """Return what lets a joint show other states from a cycle on; one with a position stays there."""

        def change():
            for name, value in states.items():
                getattr(self.states, name)[row] = value
            if "position" in states:
                self.hardware.read_states = lambda: None

        return change

    def goals(self, row):
        return np.array([position[row] for position, _ in self.hardware.written])


@pytest.fixture
def story():
    return Story()


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
    limp, back = story.shows(2, torque=Torque.OFF, position=0.25), story.shows(2, position=0.9, valid=True)
    story.run(12, {3: limp, 5: story.shows(2, torque=Torque.GIVEN, valid=False), 7: back})
    np.testing.assert_allclose(story.goals(2), [0.25] * 7 + [0.9] * 5)
    text = "restarted at the measured positions: j2 regained torque"
    assert story.events.texts(EventCode.POLICY) == [text]


def test_joint_that_a_hand_turns_slowly_in_a_pause_is_anchored_there(story):
    """A wheel may coast at the start of a pause. This one was at rest before, and is again at the end."""
    story.script("wheel", commanding(velocity=0.0), joints=("j2",), command=("velocity",)).build()
    turned = {cycle: story.shows(2, velocity=0.5, position=0.2 + 0.02 * cycle) for cycle in range(6, 14)}
    at = {3: story.asks("pause"), 14: story.shows(2, velocity=0.0), 16: story.asks("resume")}
    story.run(20, turned | at)
    text = "restarted at the measured positions: j2 moved in the pause"
    assert story.events.of(EventCode.POLICY) == [("wheel", text)]


def test_a_long_list_is_cut_in_the_sentence_and_whole_in_its_fields():
    joints = tuple(f"j{row}" for row in range(20))
    refusal = Refusal(Code.UNKNOWN_JOINT, {"joint": joints})
    assert refusal.text == "there is no joint j0, j1, j2, j3 and 16 more"
    assert refusal.fields["joint"] == joints
    assert Refusal(Code.UNKNOWN_JOINT, {"joint": joints[:5]}).text == "there is no joint j0, j1, j2, j3, j4"
