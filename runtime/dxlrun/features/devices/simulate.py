"""Simulated devices: the values that a device on a simulated bus returns."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from dxlrun.compile.problems import RobotFile
from dxlrun.errors import suggestion
from dxlrun.features.devices import form
from dxlsim.simulation_plan import DeviceReadings
from dxlwire.control_table.control_items import ControlItem
from dxlwire.control_table.device_table import DeviceTable


def simulated_states(
    file: RobotFile,
    name: str,
    table: DeviceTable,
    read: Mapping[str, ControlItem],
    links: Collection[str] | None,
) -> DeviceReadings:
    """Return values, noise and link of a simulated device; add problems of its `simulation` keys to the file.

    Args:
        file: Robot file; collects the problems.
        name: Name of the device.
        table: Control table of its model.
        read: Item of each state, by the state's name.
        links: Links of the robot's URDF; None if it has none.
    """
    keys = form.STAGE.section_of(file.robot)[name].simulation
    for key, numbers in (("values", keys.values), ("noise", keys.noise)):
        for state, number in numbers.items():
            mark = file.at("devices", name, "simulation", key, state)
            if state not in read:
                file.error(mark, f"{name} has no state {state}", suggestion(state, tuple(read)))
            elif key == "noise" and number < 0:
                file.error(mark, f"the noise of {state} is negative", "write a standard deviation")
    if keys.link and (links is None or keys.link not in links):
        mark = file.at("devices", name, "simulation", "link")
        if links is None:
            what = f"{name} is on link {keys.link}, but the robot file has no URDF"
            file.error(mark, what, "write `model: {urdf: ...}`, or remove link")
        else:
            what = f"link {keys.link} of {name} is not in the URDF"
            file.error(mark, what, suggestion(keys.link, tuple(links)))
    return DeviceReadings(
        states={item.name: state for state, item in read.items()},
        values={read[state].name: value for state, value in keys.values.items() if state in read},
        noise={read[state].name: value for state, value in keys.noise.items() if state in read},
        link=keys.link,
        table=table.text,
    )
