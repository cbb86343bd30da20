"""Check of the section `lights` against the robot's joints and the control tables of their servos."""

from __future__ import annotations

import msgspec

from dxlrun.tooling.features import Compilation, CompileStage, Contribution, SourcePlan
from dxlrun.tooling.files import suggestion
from dxlrun_lights import form
from dxlrun_lights.plan import LightPlan


def compile_lights(compilation: Compilation) -> Contribution:
    """Return the lights as commands of one source, `lights/NAME`, from 0 (off) to 1 (on).

    Reports an error for each light whose joint or LED does not exist, or that another light has.
    """
    file, found, owners = compilation.file, dict[str, LightPlan](), dict[tuple[str, int], str]()
    lights = form.STAGE.section_of(file.robot)
    for name, light in lights.items():
        mark = file.at("lights", name, "joint")
        if light.joint not in file.robot.joints:
            what = f"light {name}: {light.joint} is not a joint"
            file.error(mark, what, suggestion(light.joint, tuple(file.robot.joints)))
        elif (joint := compilation.joints.get(light.joint)) is not None:
            servo = joint.servos[0]
            place = (servo.described.bus, servo.described.id)
            if (led := servo.table.items.get("led")) is None:
                what = f"light {name}: the {servo.table.model} of {light.joint} has no item led"
                file.error(mark, what, "name another joint; `dxlrun models MODEL` lists the items of a model")
            elif (other := owners.setdefault(place, name)) != name:
                what = f"light {name}: light {other} already uses the LED of {light.joint}"
                file.error(mark, what, "name another joint, or remove one of the lights")
            else:
                found[name] = LightPlan(light.joint, *place, led.address)
    if len(found) < len(lights):  # without the source, controllers with these commands get no error
        return Contribution(names=("lights",))
    source = SourcePlan(
        "lights", "light", (), tuple(found), ((0.0, 1.0),) * len(found), label="lights", commandable=True
    )
    return Contribution(("lights",), sources=(source,), plan=msgspec.json.encode(found))


STAGE = CompileStage(compile_lights)
