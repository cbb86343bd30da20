"""Compiles the section `sensors` and checks it against plug-ins, names, the URDF and the simulation."""

from __future__ import annotations

import json
from collections.abc import Collection

from dxlrun.compile.contribution import Compilation, CompileStage, Contribution
from dxlrun.compile.controller_entry import PlugInCode, where_to_get
from dxlrun.compile.controllers import report_entry
from dxlrun.compile.problems import RobotFile
from dxlrun.control.controllers.offers import DriverOffer
from dxlrun.control.controllers.plugin_loading import PlugIns
from dxlrun.errors import Mark, suggestion
from dxlrun.features.sensors import form
from dxlrun.features.sensors.form import SensorEntry
from dxlrun.features.sensors.offer import is_units, names_breach
from dxlrun.features.sensors.plan import SensorPlan, encode_sensors
from dxlrun.plan.loop_plan import SourcePlan
from dxlwire.bus_plan import SIMULATED

_LEAST_TIMEOUT_NS = 50_000_000  # a process without real-time priority may wait so long for a processor
# default timeout in periods of the sensor; a single late sample must not make it invalid
_TIMEOUT_PERIODS = 5


def compile_sensors(compilation: Compilation) -> Contribution:
    """Return plans and sources of the sensors; those with a wrong type or parameters are missing."""
    file, body = compilation.file, compilation.body
    links = None if body is None else body.urdf.links
    described = form.STAGE.section_of(file.robot)
    found = (_compiled(file, name, entry, compilation.plugins, links) for name, entry in described.items())
    sensors = tuple(each for each in found if each is not None)
    return Contribution(
        names=tuple(described),
        sources=tuple(
            SourcePlan(plan.name, "sensor", plan.states, label=f"sensor {plan.name}", units=dict(plan.units))
            for plan in sensors
        ),
        links={plan.name: plan.links[0] for plan in sensors if len(plan.links) == 1},
        plan=encode_sensors(sensors),
        packages=compilation.plugins.packages_of_drivers(
            "sensors", {sensor.type: sensor.distribution for sensor in sensors}
        ),
    )


STAGE = CompileStage(compile_sensors)


def _compiled(
    file: RobotFile, name: str, entry: SensorEntry, plugins: PlugIns, known: Collection[str] | None
) -> SensorPlan | None:
    marks = file.marks
    offer = plugins.drivers_of("sensors").get(entry.type)
    if offer is None:
        file.error(
            marks.value("sensors", name, "type"),
            f"no plug-in offers the sensor type {entry.type} of {name}",
            where_to_get(entry.type, tuple(plugins.drivers_of("sensors")), plugins.broken),
        )
        return None
    period_ns = round(1e9 / (entry.rate or file.robot.loop.rate))
    plan = report_entry(
        file, "sensor", name, entry, offer.driver.Parameters, lambda: _plan(name, entry, offer, period_ns)
    )
    if plan is None:
        return None
    _check_links(file, name, entry, plan.links, known)
    if entry.timeout is not None and entry.timeout <= period_ns:
        file.error(
            marks.value("sensors", name, "timeout"),
            f"{name} delivers a sample every {period_ns / 1e6:g} ms, but counts as lost after "
            f"{entry.timeout / 1e6:g} ms without one",
            "write a longer timeout, such as five periods, or the correct rate",
        )
    return plan


def _plan(name: str, entry: SensorEntry, offer: DriverOffer, period_ns: int) -> SensorPlan:
    """Return the plan of a sensor from its entry and from what its class returns (states, links, units).

    Raises:
        ValidationError: The parameters are invalid.
        WrongEntry: The plug-in's code failed or broke its contract.
    """
    sensor, code = offer.driver, PlugInCode("sensor", name, offer.distribution)
    parameters = code.parameters(entry.parameters, sensor.Parameters)
    with code.asked_to("name its states and links"):
        states, links = sensor.states(parameters), sensor.links(parameters)
        breach = names_breach(states, links)
        noisy = () if breach else sensor.noisy(parameters)
        units = {} if breach else sensor.units(parameters)
    if not breach and not (isinstance(noisy, tuple) and set(noisy) <= set(states)):
        breach = f"returns {noisy!r} from noisy", "return a tuple of its states"
    if not breach and not is_units(units, states):
        breach = f"returns {units!r} from units", "return a mapping from its states to texts"
    if breach:
        raise code.broken(breach)
    return SensorPlan(
        name=name,
        type=entry.type,
        distribution=offer.distribution,
        parameters=json.dumps(entry.parameters),  # as written, because the model accepts `60 deg`
        states=states,
        period_ns=period_ns,
        timeout_ns=entry.timeout or max(_TIMEOUT_PERIODS * period_ns, _LEAST_TIMEOUT_NS),
        on_lost=entry.on_lost,
        links=links,
        simulated=sensor.simulated,
        noisy=noisy,
        units=dict(units),
    )


def _check_links(
    file: RobotFile,
    name: str,
    entry: SensorEntry,
    links: Collection[str],
    known: Collection[str] | None,
) -> None:
    """Add errors if a sensor of simulated links has no URDF, a real bus, or a link that does not exist."""
    robot = file.robot
    if not links:
        return
    mark = file.key("sensors", name)
    if robot.model is None:
        file.error(
            mark,
            f"{name} senses the motion of link {', '.join(links)}, but the robot file has no URDF",
            "write `model: {urdf: ...}`",
        )
    real = [bus for bus, each in robot.buses.items() if each.port != SIMULATED]
    if real:
        file.error(
            mark,
            f"{name} senses the simulated body, but bus {', '.join(real)} has a real port",
            "write a `type` of a real sensor, or run with port:=sim",
        )
    for link in links:
        if known is not None and link not in known:
            file.error(
                _text_mark(file, name, entry, link),
                f"link {link} of {name} is not in the URDF",
                suggestion(link, tuple(known)),
            )


def _text_mark(file: RobotFile, name: str, entry: SensorEntry, text: str) -> Mark:
    """Return line and column of a text in a sensor's parameters, else those of the sensor."""
    for key, value in entry.parameters.items():
        if value == text:
            return file.at("sensors", name, key)
    return file.key("sensors", name)
