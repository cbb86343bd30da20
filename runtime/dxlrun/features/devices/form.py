"""Form of the section `devices` of a robot file: nodes on a servo bus that are not servos."""

import math
import re
from typing import Annotated

from pydantic import Field, PlainValidator, WithJsonSchema

from dxlrun.description.base_form import Form, Name, key, validation_error
from dxlrun.features.feature import Section

_STATE = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)*", re.ASCII)
_ITEM = re.compile(r"[a-z][a-z0-9_]*", re.ASCII)


def _items(value: object) -> tuple[tuple[str, str], ...]:
    """Validate a list of items or a mapping NAME: ITEM into pairs; the names from a list are empty."""
    if isinstance(value, list) and value:
        pairs = [("", each) for each in value]
    elif isinstance(value, dict) and value:
        pairs = [*value.items()]
    else:
        raise validation_error("this is not a list of items", "write a list of items, or NAME: ITEM for each")
    for name, item in pairs:
        if not isinstance(item, str) or not _ITEM.fullmatch(item):
            raise validation_error(
                f"{item!r} is not a name of an item", "`dxlrun models MODEL` lists the items"
            )
        if name and not _STATE.fullmatch(name):
            raise validation_error(
                f"{name!r} is not a name of a state",
                "start with a letter, and use letters, digits and _, such as angular_velocity.x",
            )
        if name == "age":
            raise validation_error("the name age is reserved", "choose another name")
    items = [item for _, item in pairs]
    for item in items:
        if items.count(item) > 1:
            raise validation_error(f"{item} is named twice", "name each item once")
    return tuple(pairs)


Items = Annotated[
    tuple[tuple[str, str], ...],
    PlainValidator(_items),
    WithJsonSchema(
        {
            "anyOf": [
                {
                    "type": "array",
                    "minItems": 1,
                    "items": {"type": "string", "pattern": f"^{_ITEM.pattern}$"},
                },
                {
                    "type": "object",
                    "minProperties": 1,
                    "propertyNames": {"pattern": f"^{_STATE.pattern}$"},
                    "additionalProperties": {"type": "string", "pattern": f"^{_ITEM.pattern}$"},
                },
            ]
        }
    ),
]
"""Names with control table items, in file order; an empty name means the name in the control table."""


def _numbers(value: object) -> dict[str, float]:
    if not isinstance(value, dict):
        raise validation_error(
            "this is not a mapping of states to numbers", "write STATE: NUMBER for each, in SI units"
        )
    for name, number in value.items():
        if not isinstance(name, str) or isinstance(number, bool) or not isinstance(number, int | float):
            raise validation_error(f"{number!r} is not a number", "write a number in SI units")
        if not math.isfinite(number):
            raise validation_error(f"{number!r} is not finite", "write a finite number in SI units")
    return {name: float(number) for name, number in value.items()}


Numbers = Annotated[
    dict[str, float],
    PlainValidator(_numbers),
    WithJsonSchema({"type": "object", "additionalProperties": {"type": "number"}}),
]
"""Numbers in SI units by the name of a state or command, such as `{led: 0}`."""


class DeviceSimulation(Form):
    """Form of `simulation` of a device: values and noise of its simulated states."""

    values: Numbers = key(
        "Constant values of states, SI units; other states have the simulated quantity of their name, or 0.",
        "{force.x: 12.5}",
        {},
    )
    noise: Numbers = key(
        "Standard deviations of the noise of states, SI units; no noise by default.", "{force.x: 0.2}", {}
    )
    link: str = key(
        "URDF link that carries the IMU; an IMU without a link is upright and at rest.", "torso", ""
    )


class Device(Form):
    """Form of one device on a bus, such as an IMU, a foot with pressure sensors, or a power board."""

    bus: str = key("Name of the device's bus.", "main")
    id: int = key("ID of the device, unique among the servos and devices of the bus.", "241", ge=0, le=253)
    model: str = Field(
        min_length=1,
        description="Model of the device (see `dxlrun models`), or the TOML file of its control table.",
        examples=["generic", "boards/my_board.toml"],
    )
    states: Items = key(
        "Items read in each cycle, as a list or as NAME: ITEM; the cyclic items of the control table "
        "by default.",
        "{pressure.left: register_1, pressure.right: register_2}",
        (),
    )
    commands: Items = key("Items that controllers may command, as a list or as NAME: ITEM.", "[led]", ())
    safe: Numbers = key(
        "Values of commands, SI units, for a stopped controller and for the end of the run; by default "
        "the safe values in the control table.",
        "{led: 0}",
        {},
    )
    simulation: DeviceSimulation = key(
        "States of the simulated device.", "{link: torso}", DeviceSimulation.of_defaults()
    )


STAGE: Section[dict[str, Device]] = Section(
    "devices",
    dict[Name, Device],
    key("Devices on a bus other than servos, by name.", "{imu: {bus: main, id: 241, model: ...}}", {}),
    before="controllers",
)
