"""A register that a client changes: accepted in one cycle, answered when the servo has it."""

import pytest

from dxlrun.channels.answers import Code, Done
from dxlrun.channels.events import EventCode


@pytest.fixture
def steered(make_robot):
    """Run cycles; `at` maps a cycle's number to what happens before it."""

    def run(cycles, at):
        robot = make_robot()
        robot.build()
        robot.written = []
        robot.hardware.set_register = lambda *given: robot.written.append(given)

        def idle(deadline_ns):
            number = len(robot.sink.cycles)
            at.get(number, lambda _: None)(robot)
            if number == cycles - 1:
                robot.stop.request()

        robot.hardware.idle = idle
        robot.loop.run()
        return robot

    return run


def change(robot, **other):
    robot.number = robot.ask("register", **({"joint": "j1", "item": "p_gain", "value": 40} | other))


def test_it_is_answered_when_it_is_there_and_not_before(steered):
    answers = []

    def look(robot):
        answers.append(dict(robot.refusals))

    def settled(robot):
        ((row, item, value, done),) = robot.written
        assert (row, item, value) == (1, "p_gain", 40)
        look(robot)
        done("", 32)
        look(robot)

    robot = steered(6, {1: change, 2: look, 4: settled})
    assert answers == [{}, {}, {robot.number: ""}]
    assert robot.answer(robot.number) == Done(3, value=32)  # it was there before cycle 4
    ((source, text),) = robot.events.of(EventCode.STEERED)
    assert (source, text) == ("loop", 'register {"joint":"j1","item":"p_gain","value":40} from anna')
    (taken,) = [one for one in robot.taken if one.kind == "register"]
    assert (taken.cycle, taken.text) == (1, '{"joint":"j1","item":"p_gain","value":40}')


def test_what_went_wrong_is_the_answer(steered):
    robot = steered(4, {1: change, 2: lambda robot: robot.written[0][3]("j1 did not answer", None)})
    assert robot.answer(robot.number) == (Code.REGISTER_NOT_WRITTEN, {"problem": "j1 did not answer"})


@pytest.mark.parametrize(
    ("other", "code", "said"),
    [
        ({"joint": "j9"}, Code.UNKNOWN_JOINT, "there is no joint j9"),
        ({"value": 1.5}, Code.INVALID, "Expected `int`, got `float` - at `$.value`"),
        ({"more": 1}, Code.INVALID, "Object contains unknown field `more`"),
    ],
)
def test_what_cannot_be_is_refused_at_once(steered, other, code, said):
    robot = steered(3, {1: lambda robot: change(robot, **other)})
    assert said in robot.refusals[robot.number]
    assert robot.answer(robot.number)[0] is code
    assert robot.written == []
