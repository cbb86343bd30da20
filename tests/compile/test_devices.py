"""Devices of a robot file: places, models, items and names are checked; the plan says what is read."""

import pytest
from tests.kit.robots import compile_text, problems_in

ROBOT = """\
name: with_devices
buses:
  main: {port: /dev/ttyUSB0, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}}
loop: {rate: 50}
joints:
  neck: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}
devices:
  foot: {bus: main, id: 101, model: generic, states: {force.x: register_1, force.y: register_3}}
  light: {bus: main, id: 102, model: generic, states: [led, register_2], commands: {lamp: led}}
  board: {bus: main, id: 103, model: generic}
"""


def test_devices_are_the_first_sources_in_the_order_of_the_file():
    plan = compile_text(ROBOT).plan
    assert plan.loop.source_states == {
        "foot": ("force.x", "force.y"),
        "light": ("led", "register_2"),
        "board": ("register_1", "register_2"),
    }
    assert plan.loop.device_commands == ("light/lamp",)
    foot, light, board = plan.buses[0].devices
    assert [(one.name, one.servo_id, one.source, one.model_number) for one in (foot, light, board)] == [
        ("foot", 101, 0, 65_000),
        ("light", 102, 1, 65_000),
        ("board", 103, 2, 65_000),
    ]
    # two bytes between the two registers are quicker read than left out; led and register_2 are far apart
    assert [(block.address, block.length) for block in foot.blocks] == [(128, 6)]
    assert [(one.state, one.place.offset, one.column) for one in foot.blocks[0].fields] == [
        ("force.x", 0, 0),
        ("force.y", 4, 1),
    ]
    assert [(block.address, block.length) for block in light.blocks] == [(65, 1), (130, 2)]
    (lamp,) = light.commands
    assert (lamp.name, lamp.address, lamp.lowest, lamp.highest, lamp.safe) == ("lamp", 65, 0.0, 1.0, 0)
    given = compile_text(ROBOT.replace("{lamp: led}", "{lamp: led}, safe: {lamp: 1}")).plan
    assert given.buses[0].devices[1].commands[0].safe == 1
    assert plan.loop.sources[1].label == "light (ID 102 on bus main)"


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        ("bus: main, id: 101", "bus: >mian, id: 101", "foot is on bus mian, which is not defined"),
        ("id: 101", "id: >1", "ID 1 of foot is taken by neck on bus main; give every servo"),
        ("id: 102", "id: >101", "ID 101 of light is taken by foot on bus main"),
        ("id: 101", "id: >253", "ID 253 of foot is not valid in Protocol 2.0; give it one from 0 to 252"),
        (
            "103, model: generic",
            "103, model: >genric",
            "no control table for the device genric of board; did you",
        ),
        (
            "register_3",
            ">regster_3",
            "the device generic of foot has no item regster_3; did you mean register_3",
        ),
        ("led, register_2", "led, >register_9", "the device generic of light has no item register_9"),
        ("{force.x: register_1", ">{force-x: register_1", "'force-x' is no name of a state"),
        ("{force.x: register_1", ">{age: register_1", "every device has an age already"),
        ("[led, register_2]", ">[led, led]", "led is named twice"),
        ("[led, register_2]", ">[]", "this names no item of the device's table; write a list of items"),
        (
            "{lamp: led",
            "{lamp: >id",
            "id of light (generic) stands in EEPROM, which wears out; take one of led",
        ),
        ("{lamp: led", "{lamp: >firmware_version", "firmware_version of light (generic) cannot be written"),
        (
            "{lamp: led}",
            "{lamp: led}, safe: {lamp: >7}",
            "light/lamp = 7 lies outside its range; give it 0 to 1",
        ),
        (
            "{lamp: led}",
            "{lamp: led}, safe: {lamp: >-1}",
            "light/lamp = -1 lies outside its range; give it 0 to 1",
        ),
        ("{lamp: led}", "{lamp: led}, safe: {lmp: >1}", "lmp is no command of light; did you mean lamp?"),
        ("  board:", "  >neck:", "neck is the name of a joint already, and both have states"),
    ],
)
def test_what_is_wrong_is_named_at_its_place(before, after, sentence):
    assert before in ROBOT
    marked = ROBOT.replace(before, after, 1)
    above, _, _ = marked.partition(">")
    problems = problems_in(marked.replace(">", "", 1))
    (found,) = [one for one in problems if sentence in f"{one.what}; {one.fix}"]
    line = above.count("\n") + 1
    assert (found.mark.line, found.mark.column) == (line, len(above.rpartition("\n")[2]) + 1)
    assert found.severity == "error"


def test_a_device_of_the_other_protocol_is_refused():
    (found, *_) = problems_in(ROBOT.replace("protocol: 2.0", "protocol: 1.0").replace("XL430-W250", "AX-12A"))
    assert "generic of foot speaks Protocol 2.0, bus main Protocol 1.0" in found.what
