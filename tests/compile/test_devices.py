"""Devices of a robot file: places, models, items and names are checked; the plan says what is read."""

from tests.kit.robots import compile_text, robot_text

from dxlrun.features.devices.plan import decode_devices

ROBOT = robot_text("devices")


def commands_of(plan):
    return decode_devices(plan.loop.feature_plans["devices"])


def test_devices_are_the_first_sources_in_the_order_of_the_file():
    plan = compile_text(ROBOT).plan
    assert plan.loop.source_states == {
        "foot": ("force.x", "force.y"),
        "light": ("led", "register_2"),
        "board": ("register_1", "register_2"),
    }
    assert plan.loop.source_commands == ("light/lamp",)
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
    (lamp,) = commands_of(plan)["light"]
    assert (lamp.name, lamp.address, lamp.lowest, lamp.highest, lamp.safe) == ("lamp", 65, 0.0, 1.0, 0)
    given = compile_text(ROBOT.replace("{lamp: led}", "{lamp: led}, safe: {lamp: 1}")).plan
    assert commands_of(given)["light"][0].safe == 1
    assert plan.loop.sources[1].label == "light (ID 102 on bus main)"
