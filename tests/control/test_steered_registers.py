"""A register that a client changes: accepted in one cycle, answered when the servo has it."""

import pytest

from dxlrun.run.channels.events import EventCode


@pytest.fixture
def steered(make_robot):
    """Run cycles; `at` maps a cycle's number to what happens before it."""

    def run(cycles, at):
        robot = make_robot()
        robot.build()
        robot.wishes = []
        robot.hardware.set_register = lambda *wanted: robot.wishes.append(wanted)

        def idle(deadline_ns):
            number = len(robot.sink.cycles)
            at.get(number, lambda _: None)(robot)
            if number == cycles - 1:
                robot.stop.request()

        robot.hardware.idle = idle
        robot.loop.run()
        return robot

    return run


def wish(robot, **change):
    robot.number = robot.ask("register", **({"joint": "j1", "item": "p_gain", "value": 40} | change))


def test_it_is_answered_when_it_is_there_and_not_before(steered):
    answers = []

    def look(robot):
        answers.append(dict(robot.inbox.answers))

    def written(robot):
        ((row, item, value, done),) = robot.wishes
        assert (row, item, value) == (1, "p_gain", 40)
        look(robot)
        done("")
        look(robot)

    robot = steered(6, {1: wish, 2: look, 4: written})
    assert answers == [{}, {}, {robot.number: ""}]
    ((source, text),) = robot.events.of(EventCode.STEERED)
    assert (source, text) == ("loop", 'register {"joint":"j1","item":"p_gain","value":40} from anna')
    (taken,) = [one for one in robot.taken if one.kind == "register"]
    assert (taken.cycle, taken.text) == (1, '{"joint":"j1","item":"p_gain","value":40}')


def test_what_went_wrong_is_the_answer(steered):
    robot = steered(4, {1: wish, 2: lambda robot: robot.wishes[0][3]("j1 did not answer")})
    assert robot.inbox.answers == {robot.number: "j1 did not answer"}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"joint": "j9"}, "there is no joint j9"),
        ({"value": 1.5}, "its data does not fit: Expected `int`, got `float` - at `$.value`"),
        ({"more": 1}, "its data does not fit: Object contains unknown field `more`"),
    ],
)
def test_what_cannot_be_is_refused_at_once(steered, change, said):
    robot = steered(3, {1: lambda robot: wish(robot, **change)})
    assert robot.inbox.answers == {robot.number: said}
    assert robot.wishes == []
