"""Joints with several servos and linear joints, as clients name and command them."""

import pytest
from msgspec.structs import replace

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.errors import InputError
from dxlrun.plan.robot_plan import Plan
from dxlrun.remote.named.named_joints import (
    effort_units,
    position_unit,
    prepared_reading,
    prepared_register,
    read_register,
    require_reboots,
)
from dxlrun.remote.preparation import RefusedRequest
from dxlrun_lab.guided.choice import require_own_servos

ROBOT = """\
name: shared
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}
loop: {rate: 50}
joints:
  head: {bus: main, id: 9, model: XM430-W350, reference: 180 deg, direction: 1}
  hip: {bus: main, model: XM430-W350, reference: 180 deg, direction: 1,
        servos: [{id: 1}, {id: 2, direction: -1}], limits: {position: [-60 deg, 60 deg]}}
  knee: {bus: main, id: 8, model: XM430-W350, reference: 180 deg, direction: 1, gear_ratio: 2.5}
  slide: {bus: main, id: 3, model: XL430-W250, reference: 180 deg, direction: 1, travel_per_turn: 60 mm,
          limits: {position: [-10 mm, 10 mm]}}
  pitch: {limits: {position: [-30 deg, 30 deg]}}
  roll: {limits: {position: [-30 deg, 30 deg]}}
transmissions:
  wrist:
    type: differential
    joints: [pitch, roll]
    servos:
      left: {bus: main, id: 4, model: XM430-W350, reference: 180 deg, direction: 1}
      right: {bus: main, id: 5, model: XM430-W350, reference: 180 deg, direction: -1}
"""


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    path = tmp_path_factory.mktemp("shared") / "shared.yaml"
    path.write_text(ROBOT)
    return compile_files(path, {}, ()).plan


def test_a_register_is_that_of_all_servos_of_a_joint_or_of_the_one_that_is_named(plan: Plan) -> None:
    rows = {servo.own_name: servo.row for bus in plan.buses for servo in bus.servos}
    for name in ("hip/1", "hip/2", "wrist/left"):
        beyond = len(plan.loop.joints) + rows[name]
        assert prepared_reading(plan, name, "present_current").row == beyond
        assert prepared_register(plan, name, "led", 1).row == beyond
    for name in ("hip", "pitch"):
        assert prepared_reading(plan, name, "present_current").row is None
        assert prepared_register(plan, name, "led", 1).row is None
    shown = read_register(plan, "hip/2", "position_p_gain", 900)
    assert (shown["joint"], shown["value"]) == ("hip/2", 900)
    with pytest.raises(RefusedRequest, match="hip/3"):
        prepared_reading(plan, "hip/3", "led")


def test_servos_of_several_models_have_no_register_together(plan: Plan) -> None:
    (bus,) = plan.buses
    other = tuple(
        replace(servo, model="XL430-W250") if servo.own_name == "hip/2" else servo for servo in bus.servos
    )
    mixed = replace(plan, buses=(replace(bus, servos=other),))
    expected = r"hip has servos of several models \(XM430-W350, XL430-W250\); name one of them: hip/1, hip/2"
    with pytest.raises(RefusedRequest, match=expected):
        prepared_register(mixed, "hip", "led", 1)
    assert prepared_register(mixed, "hip/2", "led", 1).value == 1


def test_all_servos_of_a_joint_must_know_a_reboot(plan: Plan) -> None:
    require_reboots(plan, ("hip", "roll"))


def test_experiments_on_single_servos_refuse_what_is_none(plan: Plan) -> None:
    require_own_servos(plan, ("head", "knee"), "characterize", gears=True)
    with pytest.raises(InputError) as refused:
        require_own_servos(plan, ("head", "hip", "knee", "slide", "roll"), "identify", gears=False)
    assert [sentence.partition(";")[0] for sentence in refused.value.sentences] == [
        "hip has 2 servos (ID 1 and 2 on bus main), but `dxlrun identify` measures one servo",
        "knee has a gear of 2.5 : 1, but `dxlrun identify` measures one servo",
        "slide is linear, but `dxlrun identify` measures one servo",
        "roll has 2 servos (ID 4 and 5 on bus main), but `dxlrun identify` measures one servo",
    ]


def test_units_are_those_of_the_joint(plan: Plan) -> None:
    units = [position_unit(plan, joint.name) for joint in plan.loop.joints]
    assert units == ["rad", "rad", "rad", "m", "rad", "rad"]
    assert effort_units(plan) == {
        "head": "A",
        "hip": "A",
        "knee": "A",
        "slide": "",
        "pitch": "A",
        "roll": "A",
    }
