"""Form of the section `lights` of the robot file."""

from __future__ import annotations

from dxlrun.tooling.features import Section
from dxlrun.tooling.files import Form, Name, key


class Light(Form):
    """An entry of the section `lights`: the LED of a servo."""

    joint: Name = key("Joint whose first servo has the LED.", "pan_joint")


STAGE: Section[dict[str, Light]] = Section(
    "lights", dict[Name, Light], key("Lights by name: LEDs of servos.", "{left: {joint: pan_joint}}", {})
)
