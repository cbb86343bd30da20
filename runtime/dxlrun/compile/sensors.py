"""Sensors of the robot file against plug-ins, names, the URDF and the simulation."""

from __future__ import annotations

import json
from collections.abc import Collection

from dxlrun.compile.controllers import at_fault, parameters_of, raised, where_to_get
from dxlrun.compile.joints.urdf import CompiledUrdf
from dxlrun.compile.problems import RobotFile
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.control.sensors.offer import SensorOffer, names_breach
from dxlrun.description.bus import SIMULATED
from dxlrun.description.form import ParametersModel
from dxlrun.description.reading import Description
from dxlrun.errors import Mark, suggestion
from dxlrun.plan.loop_plan import SensorPlan, SourcePlan

_LEAST_TIMEOUT_NS = 50_000_000  # A process without real time may wait so long for a processor
_TIMEOUT_PERIODS = 5


def sensor_source(plan: SensorPlan) -> SourcePlan:
    """Return a sensor's states as controllers and the record see them."""
    return SourcePlan(plan.name, "sensor", plan.states, label=f"sensor {plan.name}")


def compile_sensors(file: RobotFile, plugins: PlugIns, body: CompiledUrdf | None) -> tuple[SensorPlan, ...]:
    """Return the sensors that could be compiled, in the order of the file; `body`: of the robot's URDF."""
    links = None if body is None else body.urdf.links
    found = (_compiled(file, name, plugins, links) for name in file.robot.sensors)
    return tuple(one for one in found if one is not None)


def _compiled(
    file: RobotFile, name: str, plugins: PlugIns, known: Collection[str] | None
) -> SensorPlan | None:
    entry, marks = file.robot.sensors[name], file.marks
    offer = plugins.sensors.get(entry.type)
    if offer is None:
        file.error(
            marks.value("sensors", name, "type"),
            f"no plug-in offers the sensor type {entry.type} of {name}",
            where_to_get(entry.type, tuple(plugins.sensors), plugins.broken),
        )
        return None
    parameters = parameters_of(file, "sensor", name, offer.distribution, offer.sensor.Parameters)
    if parameters is None:
        return None
    names = _names(file, name, offer, parameters)
    if names is None:
        return None
    states, links, noisy = names
    _check_links(file, name, links, known)
    rate = entry.rate or file.robot.loop.rate
    period_ns = round(1e9 / rate)
    if entry.timeout is not None and entry.timeout <= period_ns:
        file.error(
            marks.value("sensors", name, "timeout"),
            f"{name} brings a sample every {period_ns / 1e6:g} ms, and is to be lost after "
            f"{entry.timeout / 1e6:g} ms without one",
            "write a longer timeout, such as five periods, or the rate that it has",
        )
    return SensorPlan(
        name=name,
        type=entry.type,
        distribution=offer.distribution,
        parameters=json.dumps(entry.parameters),  # as written: `60 deg` is what the model accepts
        states=states,
        period_ns=period_ns,
        timeout_ns=entry.timeout or max(_TIMEOUT_PERIODS * period_ns, _LEAST_TIMEOUT_NS),
        on_lost=entry.on_lost,
        links=links,
        simulated=offer.sensor.simulated,
        noisy=noisy,
    )


def _names(
    file: RobotFile, name: str, offer: SensorOffer, parameters: ParametersModel
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]] | None:
    """Return the states of a sensor, its links, and the states with noise; None where its code is wrong."""
    sensor = offer.sensor
    try:
        states, links = sensor.states(parameters), sensor.links(parameters)
        breach = names_breach(states, links)
        noisy = () if breach else sensor.noisy(parameters)
    except Exception as error:  # foreign code
        at_fault(file, "sensor", name, offer.distribution, raised("name its states and links", error))
        return None
    if not breach and not (isinstance(noisy, tuple) and set(noisy) <= set(states)):
        breach = f"returns {noisy!r} from noisy", "return a tuple of its states"
    if breach:
        what, fix = breach
        at_fault(file, "sensor", name, offer.distribution, (what, f"report it to its author: {fix}"))
        return None
    return states, links, noisy


def _check_links(file: RobotFile, name: str, links: Collection[str], known: Collection[str] | None) -> None:
    """Check that what a simulated sensor senses is there."""
    robot = file.robot
    if not links:
        return
    mark = file.key("sensors", name)
    if robot.model is None:
        file.error(
            mark,
            f"{name} senses the motion of link {', '.join(links)}, and the file names no URDF",
            "write `model: {urdf: ...}`",
        )
    real = [bus for bus, each in robot.buses.items() if each.port != SIMULATED]
    if real:
        file.error(
            mark,
            f"{name} senses the simulated body, but bus {', '.join(real)} has a real port",
            "give a sensor of the robot by an argument of the file, such as type: ${imu}, or take port:=sim",
        )
    for link in links:
        if known is not None and link not in known:
            file.error(
                _text_mark(file.description, name, link),
                f"{name} is on link {link}, which the URDF does not have",
                suggestion(link, tuple(known)),
            )


def _text_mark(description: Description, name: str, text: str) -> Mark:
    """Return where a parameter of a sensor has a text; the sensor's own place if nowhere."""
    for key, value in description.robot.sensors[name].parameters.items():
        if value == text:
            return description.marks.value("sensors", name, key)
    return description.marks.key("sensors", name)
