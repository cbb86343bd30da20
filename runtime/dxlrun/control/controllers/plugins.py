"""Plug-ins: find the packages that offer controllers, and check them against the contract.

Foreign code is checked when it is loaded, so that its author reads one sentence with a fix, and no run meets
a traceback; a plug-in that is broken leaves the others usable.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

import msgspec
import pluggy
from pydantic import ValidationError

from dxlrun.contract.controller import (
    CommandModel,
    Controller,
    Interfaces,
    Mismatch,
    RobotModel,
)
from dxlrun.contract.hookspecs import CONTRACT_VERSION, GROUP, HookSpecs
from dxlrun.contract.sensor import Sensor
from dxlrun.control.controllers.live_parameters import live_mistake
from dxlrun.control.sensors.offer import (
    Breach,
    SensorClass,
    SensorOffer,
    is_model,
    methods_breach,
    sensor_breach,
)
from dxlrun.description.form import ParametersModel
from dxlrun.description.joints.motor import MotorModel
from dxlrun.description.modes import COMMAND_INTERFACES, mode_of
from dxlrun.dynamixel.control_table import add_control_table
from dxlrun.dynamixel.control_table.devices import add_device_table, is_device_table
from dxlrun.errors import ControllerFault, PlugInError
from dxlrun.messages.declared import WrongMessage, declared_message, package_of
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan, SensorPlan

_MOST_MISTAKES = 5
DERIVED_TOPICS = ("/joint_states",)
"""What the recorder makes of the cycles that a controller marks."""
_TOPIC = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
"""Part of a topic's name, by the page "Topic and Service names to DDS" of ROS 2's design."""
ControllerClass = type[Controller[Any]]

_METHODS = (
    "__init__",
    "interfaces",
    "mismatches",
    "prepare",
    "on_configure",
    "on_activate",
    "on_command",
    "on_goal",
    "on_cancel",
    "on_parameters",
    "update",
    "on_deactivate",
)
"""Called by dxlrun, all by position."""
_HOOKS = tuple(name for name in vars(HookSpecs) if name.startswith("dxlrun_"))
Decide: TypeAlias = Callable[[int, int, int], object]
"""What the hook `dxlrun_overrun` of one plug-in says: cycle, scheduled_ns, actual_ns -> policy or None."""


class OverrunHook(msgspec.Struct, frozen=True):
    """One plug-in's hook."""

    plugin: str
    """Entry point and distribution."""
    decide: Decide


class Offer(msgspec.Struct, frozen=True):
    """A controller that a plug-in offers."""

    type: str
    """The robot file's name for it."""
    controller: ControllerClass
    distribution: str
    """Its publisher: `name version`."""


Refuse: TypeAlias = Callable[[str, str], PlugInError]
"""Returns the error of one plug-in: what is wrong with it, and the fix."""
Offered = TypeVar("Offered", Offer, SensorOffer)
Make: TypeAlias = Callable[[], Offered]
"""Imports and checks a class; raises PlugInError."""


class Offers(Mapping[str, Offered]):
    """What plug-ins offer, by type; a class that is named by its place is imported when it is asked for.

    Where that fails the type is missing from then on, and `broken` says why.
    """

    def __init__(self, makes: Mapping[str, Make[Offered]], broken: dict[str, str]) -> None:
        self._makes: dict[str, Make[Offered]] = dict(makes)
        self._made: dict[str, Offered] = {}
        self._broken = broken

    def __getitem__(self, name: str) -> Offered:
        if name not in self._made:
            make = self._makes[name]
            try:
                self._made[name] = make()
            except PlugInError as error:
                del self._makes[name]
                self._broken[name] = str(error)
                raise KeyError(name) from error
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(tuple(self._makes))

    def __len__(self) -> int:
        return len(self._makes)


class LoadedPlugIn(msgspec.Struct, frozen=True):
    """A plug-in that can be used."""

    name: str
    """Of its entry point."""
    distribution: str
    """Its publisher: `name version`."""
    contract: int
    """The one that it was written for."""
    controllers: tuple[str, ...]
    """Their types."""
    servo_models: tuple[str, ...]
    overrun: bool
    """It decides about late cycles."""
    sensors: tuple[str, ...] = ()
    """Their types."""
    verbs: tuple[str, ...] = ()
    """Of the command line."""


def _any_threads(name: str) -> None:
    """Do nothing: processes without a loop may have threads."""


class PlugIns(msgspec.Struct, frozen=True):
    """All controllers that are installed, and why others are not available."""

    controllers: Mapping[str, Offer]
    """By type."""
    broken: Mapping[str, str]
    """One sentence a plug-in that could not be used, by its entry point's name, and one a type that two
    plug-ins offer, by the type's name."""
    overrun_hooks: tuple[OverrunHook, ...] = ()
    """They decide what becomes of a late cycle, in this order."""
    loaded: tuple[LoadedPlugIn, ...] = ()
    """The plug-ins themselves, in the order in which they were loaded; not those that are `broken`."""
    after_each: Callable[[str], None] = _any_threads
    """Called with a name after foreign code prepared something; it may raise PlugInError."""
    sensors: Mapping[str, SensorOffer] = msgspec.field(default_factory=dict)
    """By type."""

    def import_all(self) -> None:
        """Import every controller now: an import in a running loop takes longer than its cycle."""
        for name in self.controllers:
            if self.controllers.get(name) is not None:
                self.after_each(name)

    def built_sensor(self, plan: SensorPlan) -> Sensor[Any]:
        """Return a new sensor of the plan's type.

        Raises PlugInError (the type is not available, or its class does not take the parameters).
        """
        offer = self.sensors.get(plan.type)
        if offer is None:
            raise self._unknown("sensor", plan)
        try:
            return offer.sensor(offer.sensor.Parameters.model_validate_json(plan.parameters))
        except (Exception, SystemExit) as error:  # foreign code: one sentence instead of its traceback
            raise PlugInError(f"sensor {plan.name} cannot be built: {_one_line(error)}") from error

    def built(self, plan: ControllerPlan) -> Controller[Any]:
        """Return a new controller of the plan's type.

        Raises PlugInError (the type is not available, parameters do not fit it), and ControllerFault for
        whatever else its class raises.
        """
        offer = self.controllers.get(plan.type)
        if offer is None:
            raise self._unknown("controller", plan)
        try:
            parameters = offer.controller.Parameters.model_validate_json(plan.parameters)
            return offer.controller(parameters)
        except ValidationError as error:
            from dxlrun.description.problems import sentences_of

            wrong = "; ".join(sentences_of(error, plan.name, offer.controller.Parameters, _MOST_MISTAKES))
            raise PlugInError(f"the parameters of a controller: {wrong}") from error
        except (Exception, SystemExit) as error:  # foreign code: one sentence instead of its traceback
            raise ControllerFault(
                f"controller {plan.name} cannot be built: {type(error).__name__}: {error}"
            ) from error

    def _unknown(self, what: str, plan: SensorPlan | ControllerPlan) -> PlugInError:
        why = f" ({'; '.join(self.broken.values())})" if self.broken else ""
        return PlugInError(f"no plug-in offers the type {plan.type} of {what} {plan.name}{why}")


class _Offered(msgspec.Struct, frozen=True):
    """What one plug-in brings."""

    contract: int = 0
    controllers: Mapping[str, Make[Offer]] = msgspec.field(default_factory=dict)
    servo_models: tuple[str, ...] = ()
    overrun: Decide | None = None
    sensors: Mapping[str, Make[SensorOffer]] = msgspec.field(default_factory=dict)
    verbs: tuple[str, ...] = ()


def load_plugins(after_each: Callable[[str], None] = _any_threads) -> PlugIns:
    """Import every entry point of the group `dxlrun` and ask it for its controllers and servo models.

    `after_each` is called with the plug-in's name and distribution after its import, broken or not; what it
    raises passes through: the loop's process counts its threads there, and again when a controller was
    configured. Itself raises nothing.
    """
    controllers: dict[str, Make[Offer]] = {}
    sensors: dict[str, Make[SensorOffer]] = {}
    publishers: dict[str, str] = {}
    broken: dict[str, str] = {}
    hooks: list[OverrunHook] = []
    loaded: list[LoadedPlugIn] = []
    ambiguous: dict[str, str] = {}
    # the order must not depend on the file system: two runs load the same plug-ins in the same order
    found_points = [(_publisher(each), each.name, each) for each in entry_points(group=GROUP)]
    for publisher, name, entry_point in sorted(found_points, key=lambda each: each[:2]):
        try:
            found = _load(entry_point, publisher)
        except PlugInError as error:
            broken[_free_key(name, publisher, broken)] = str(error)
            found = _Offered()
        else:
            types, measuring, decides = (*found.controllers,), (*found.sensors,), found.overrun is not None
            models, contract = found.servo_models, found.contract
            loaded.append(
                LoadedPlugIn(name, publisher, contract, types, models, decides, measuring, found.verbs)
            )
        if found.overrun is not None:
            hooks.append(OverrunHook(f"{name} ({publisher})", found.overrun))
        after_each(f"{name} ({publisher})")
        for what, type_ in (
            *(("controller", one) for one in found.controllers),
            *(("sensor", one) for one in found.sensors),
        ):
            first = publishers.setdefault(f"{what} {type_}", publisher)
            if type_ in (controllers if what == "controller" else sensors):
                ambiguous[type_] = (
                    f"{first} and {publisher} both offer a {what} of type {type_}; neither is used: "
                    "uninstall one of them, or ask an author for another name"
                )
        controllers |= found.controllers
        sensors |= found.sensors
    for type_ in ambiguous:
        controllers.pop(type_, None)
        sensors.pop(type_, None)
    broken |= ambiguous
    return PlugIns(
        Offers(controllers, broken), broken, tuple(hooks), tuple(loaded), after_each, Offers(sensors, broken)
    )


def _publisher(entry_point: EntryPoint) -> str:
    if entry_point.dist is None:
        return "an unknown distribution"
    about = entry_point.dist.metadata  # parsed at each access
    return f"{about['Name']} {about['Version']}"


def _one_line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _free_key(name: str, publisher: str, taken: Mapping[str, str]) -> str:
    return name if name not in taken else f"{name} ({publisher})"


def _load(entry_point: EntryPoint, publisher: str) -> _Offered:
    """Return what one plug-in offers. Raises PlugInError with one sentence that names its distribution."""

    def refuse(what: str, fix: str) -> PlugInError:
        return PlugInError(f"plug-in {entry_point.name} of {publisher} {what}; {fix}")

    try:
        module = entry_point.load()
    except (Exception, SystemExit) as error:  # foreign code: whatever it does on import is its fault alone
        raise refuse(
            f"cannot be imported ({_one_line(error)})", "reinstall it, or report it to its author"
        ) from error
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(HookSpecs)
    try:
        breach = hook_breach(module, manager)
        if breach is None:
            manager.register(module, entry_point.name)
            manager.check_pending()
    except Exception as error:  # foreign code, see above: looking at an object may run its code
        raise refuse(f"has a wrong hook ({_one_line(error)})", "report it to its author") from error
    if breach is not None:
        raise refuse(*breach)
    try:
        contracts = manager.hook.dxlrun_contract()
        mappings = manager.hook.dxlrun_controllers()
        servo_models = manager.hook.dxlrun_servo_models()
        sensors = manager.hook.dxlrun_sensors()
        verbs = [str(verb.name) for added in manager.hook.dxlrun_commands() for verb in added]
    except (Exception, SystemExit) as error:  # foreign code, see above
        raise refuse(f"raised in a hook ({_one_line(error)})", "report it to its author") from error
    if not contracts:
        raise refuse("does not declare its contract", "it must implement the hook dxlrun_contract")
    contract = contracts[0]
    if not (type(contract) is int and 1 <= contract <= CONTRACT_VERSION):
        raise refuse(
            f"was written for contract {contract!r}, this dxlrun has contract {CONTRACT_VERSION}",
            "install a version of it that fits",
        )
    known: list[Offer] = []
    offers = dict(
        _made(name, controller, refuse, partial(_offer, str(name), publisher, contract, refuse, known))
        for mapping in mappings
        for name, controller in _items(mapping, "dxlrun_controllers", refuse)
    )
    measuring = dict(
        _made(name, sensor, refuse, partial(_sensor_offer, str(name), publisher, refuse))
        for mapping in sensors
        for name, sensor in _items(mapping, "dxlrun_sensors", refuse)
    )
    added = tuple(name for models in servo_models for name in _add_servo_models(models, refuse))
    return _Offered(contract, offers, added, _overrun(manager), measuring, tuple(verbs))


def _made(
    name: object, kind: object, refuse: Refuse, offer: Callable[[object], Offered]
) -> tuple[str, Make[Offered]]:
    """Return a type and what makes its offer: one that was checked, or that of a place, later."""
    if not isinstance(name, str):
        raise refuse(f"offers something under {name!r}", "the type must be a string")
    if isinstance(kind, str):
        return name, partial(_imported, name, kind, refuse, offer)
    made = offer(kind)
    return name, lambda: made


def _imported(name: str, place: str, refuse: Refuse, offer: Callable[[object], Offered]) -> Offered:
    module, _, attribute = place.partition(":")
    try:
        kind: object = getattr(import_module(module), attribute)
    except (Exception, SystemExit) as error:  # foreign code: whatever it does on import is its fault alone
        raise refuse(
            f"offers {name}, which cannot be imported from {place} ({_one_line(error)})",
            "reinstall it, or report it to its author",
        ) from error
    return offer(kind)


def _overrun(manager: pluggy.PluginManager) -> Decide | None:
    """Return what the loop calls for the hook `dxlrun_overrun`, with the arguments that the plug-in wants."""
    found = manager.hook.dxlrun_overrun.get_hookimpls()
    return partial(_call, found[0].function, found[0].argnames) if found else None


def _call(
    function: Callable[..., object], names: Sequence[str], cycle: int, scheduled_ns: int, actual_ns: int
) -> object:
    given = {"cycle": cycle, "scheduled_ns": scheduled_ns, "actual_ns": actual_ns}
    return function(**{name: given[name] for name in names})


def _add_servo_models(models: object, refuse: Refuse) -> list[str]:
    """Make the control tables of a plug-in known to this process; return the names of the models.

    Servos and devices come by one hook: each text says which of them it is.
    """
    if not isinstance(models, Sequence) or isinstance(models, str | bytes):
        raise refuse(
            "does not return a list from dxlrun_servo_models", "return TOML texts, or paths of TOML files"
        )
    names = []
    for model in models:
        if not isinstance(model, str | Path):
            raise refuse(f"offers the servo model {model!r}", "it must be a TOML text or the path of a file")
        where = f"({model}) " if isinstance(model, Path) else ""
        try:
            text = model if isinstance(model, str) else model.read_text("utf-8")
            table = add_device_table(text) if is_device_table(text) else add_control_table(text)
        except (OSError, ValueError) as error:
            raise refuse(
                f"offers a servo model {where}that cannot be used ({_one_line(error)})",
                "report it to its author",
            ) from error
        names.append(table.model)
    return names


def _items(mapping: object, hook: str, refuse: Refuse) -> list[tuple[object, object]]:
    if not isinstance(mapping, Mapping):
        raise refuse(f"does not return a mapping from {hook}", "return {type: class}")
    return list(mapping.items())


def _sensor_offer(name: str, publisher: str, refuse: Refuse, sensor: object) -> SensorOffer:
    _check(sensor_breach(sensor), sensor, name, refuse)
    return SensorOffer(name, cast("SensorClass", sensor), publisher)


def _offer(  # noqa: PLR0917  the last is given later, where a class is named by its place
    name: str, publisher: str, contract: int, refuse: Refuse, known: list[Offer], controller: object
) -> Offer:
    """Return a checked offer, and add it to those that are `known` of its plug-in."""
    _check(controller_breach(controller, contract), controller, name, refuse)
    offer = Offer(name, cast("ControllerClass", controller), publisher)
    if twofold := _twofold_message([*known, offer]):
        raise refuse(f"has two messages {twofold}", "give one of the two classes another name")
    known.append(offer)
    return offer


def _check(breach: Breach | None, kind: object, name: str, refuse: Refuse) -> None:
    if breach is not None:
        what, fix = breach
        shown = kind.__qualname__ if isinstance(kind, type) else repr(kind)
        raise refuse(f"offers {shown} as {name}, {what}", fix)


# The contract


def hook_breach(plugin: object, manager: pluggy.PluginManager) -> Breach | None:
    """Check the hooks that a module implements: their names, their marks, their arguments."""
    for name in dir(plugin):
        hook = getattr(plugin, name, None)
        marked = manager.parse_hookimpl_opts(plugin, name) is not None
        if not marked:
            if name in _HOOKS and callable(hook):
                return f"has a function {name} that is not marked as a hook", "put @dxlrun.hookimpl above it"
            continue
        if name not in _HOOKS:
            return f"implements a hook {name} that dxlrun does not have", f"hooks are {', '.join(_HOOKS)}"
        expected = [*inspect.signature(getattr(HookSpecs, name)).parameters][1:]
        found = [*inspect.signature(hook).parameters] if callable(hook) else []
        if not set(found) <= set(expected):
            return (
                f"implements {name}({', '.join(found)}), but the hook is {name}({', '.join(expected)})",
                "take the other arguments out",
            )
    return None


def controller_breach(controller: object, contract: int = CONTRACT_VERSION) -> Breach | None:
    """Check a class that is offered as a controller, by the contract that its package was written for."""
    if not (isinstance(controller, type) and issubclass(controller, Controller)):
        return "which is no controller", "derive a class from dxlrun.Controller"
    if breach := methods_breach(controller, Controller, _METHODS):
        return breach
    return _declaration_breach(controller, contract)


def interfaces_breach(interfaces: object, *, chained: bool = False) -> Breach | None:
    """Check what a controller's `interfaces` returned.

    `chained`: it commands references of other controllers, of which any may go together; servos have modes.
    """
    if not isinstance(interfaces, Interfaces):
        return f"returns {interfaces!r} from interfaces", "return dxlrun.Interfaces(joints, command)"
    if breach := _names_breach(interfaces):
        return breach
    if chained:
        return None
    try:
        mode_of(interfaces.command or ("position",))
    except ValueError as error:
        return (
            f"asks for command interfaces that do not go together: {error}",
            "ask for position (with velocity or effort beside it), or for velocity, effort or pwm alone",
        )
    return None


def _names_breach(interfaces: Interfaces) -> Breach | None:
    """Check that names are names, and those of interfaces known."""
    found: Mapping[str, object] = {
        what: getattr(interfaces, what)
        for what in (
            *("joints", "command", "reference", "reads", "motors"),
            *("provides", "device_commands", "takeovers"),
        )
    }
    for what, names in found.items():
        if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names):
            return f"asks for {what} {names!r}", f"{what} of dxlrun.Interfaces is a tuple of names"
    for what, verb, chosen in (
        ("command", "asks for", interfaces.command),
        ("reference", "exports", interfaces.reference),
    ):
        if unknown := [name for name in chosen if name not in COMMAND_INTERFACES]:
            return (
                f"{verb} the {what} interface {', '.join(unknown)}",
                f"{what} interfaces are {', '.join(COMMAND_INTERFACES)}",
            )
    if wrong := [name for name in interfaces.provides if not name or "/" in name]:
        return f"provides {', '.join(map(repr, wrong))}", "name a state as orientation.x"
    for what, given in (
        ("asks for a command interface", interfaces.command),
        ("exports a reference interface", interfaces.reference),
        ("provides a state", interfaces.provides),
        ("claims a command of a device", interfaces.device_commands),
    ):
        if len(set(given)) < len(given):
            return f"{what} twice: {', '.join(given)}", "name each once"
    figures = MotorModel.__struct_fields__
    if strange := [name for name in interfaces.motors if name not in figures]:
        return f"needs the {', '.join(strange)} of motors", f"a motor has {', '.join(figures)}"
    return None


def motor_breach(needed: Sequence[str], joint: JointPlan) -> Breach | None:
    """Return what a controller needs of a joint's motor and is not known; None where all is."""
    identify = f"let `dxlrun identify {joint.name}` measure it, and name the file that it writes"
    if needed and joint.motor is None:
        return (
            f"needs the motor of {joint.name}, which has no motor file",
            f"{identify}: `motor: {joint.name}.motor.yaml` at the joint",
        )
    lacking = [name for name in needed if getattr(joint.motor, name) is None]
    if "torque_per_effort" in lacking:
        what = f"needs the torque of {joint.name}, whose servo measures neither torque nor current"
        return what, "command positions or PWM instead"
    if lacking:
        return f"needs the {', '.join(lacking)} of {joint.name}, which its motor file does not have", identify
    return None


def mismatches(
    controller: ControllerClass,
    parameters: ParametersModel,
    motors: Sequence[str],
    joints: Sequence[JointPlan],
    urdf: str | None,
) -> list[Mismatch]:
    """Return what of the robot does not fit a controller: `motors` that it needs, and what its class finds.

    `joints` are its own. What foreign code raises passes through.
    """
    lacking = [(joint.name, motor_breach(motors, joint)) for joint in joints]
    if found := [Mismatch(*breach, name) for name, breach in lacking if breach is not None]:
        return found
    robot = RobotModel(
        tuple(joint.name for joint in joints),
        tuple(joint.servo_model for joint in joints),
        tuple(joint.motor for joint in joints),
        tuple(joint.linear for joint in joints),
        urdf,
    )
    return list(controller.mismatches(parameters, robot))


def _declaration_breach(controller: ControllerClass, contract: int) -> Breach | None:
    if not is_model(controller.Parameters, ParametersModel):
        return "whose Parameters is no model of parameters", "derive it from dxlrun.ParametersModel"
    if mistaken := live_mistake(controller.Parameters):
        return (
            f"whose parameter {mistaken} is LIVE and is neither a number nor a bool",
            "mark only parameters of type float, int and bool",
        )
    commands: object = controller.Commands
    if not isinstance(commands, Mapping) or not all(
        isinstance(kind, str) and is_model(model, CommandModel) for kind, model in commands.items()
    ):
        return "whose Commands is no mapping of names to models", "write {name: class of dxlrun.CommandModel}"
    if breach := _goals_breach(controller, commands):
        return breach
    return _publishes_breach(controller, contract) or _topics_breach(controller)


def _publishes_breach(controller: ControllerClass, contract: int) -> Breach | None:
    publishes: object = controller.publishes
    if not isinstance(publishes, tuple) or not all(isinstance(topic, str) for topic in publishes):
        return "whose publishes is no tuple of topics", 'write publishes = ("/joint_states",)'
    # a package for contract 1 could name any topic, which then went unheard, as it does now
    if contract > 1 and (unknown := [topic for topic in publishes if topic not in DERIVED_TOPICS]):
        return (
            f"whose publishes has {unknown[0]}, which is not made of the robot's cycles",
            f"declare it in Topics with the class of its messages; publishes has {', '.join(DERIVED_TOPICS)}",
        )
    return None


def _topics_breach(controller: ControllerClass) -> Breach | None:
    topics: object = controller.Topics
    if not isinstance(topics, Mapping):
        return "whose Topics is no mapping of names to messages", 'write Topics = {"state": WaveState}'
    for topic, message in topics.items():
        if not isinstance(topic, str) or not _TOPIC.fullmatch(topic):
            return (
                f"whose Topics has {topic!r}, which is no name of a topic",
                "use letters, digits and _, a letter first; it becomes /CONTROLLER/TOPIC",
            )
        try:
            declared_message(message, "any")
        except WrongMessage as wrong:
            return f"whose topic {topic} has no message of ROS 2: {wrong.what}", wrong.fix
    return None


def _twofold_message(offers: Sequence[Offer]) -> str | None:
    """Return the name of a message that the topics of these offers define in two ways."""
    known: dict[str, str] = {}
    for offer in offers:
        for message in offer.controller.Topics.values():
            found = declared_message(message, package_of(offer.distribution)).type
            if known.setdefault(found.name, found.type_hash) != found.type_hash:
                return found.name
    return None


def _goals_breach(controller: ControllerClass, commands: Mapping[str, object]) -> Breach | None:
    goals: object = controller.Goals
    if not isinstance(goals, frozenset | set) or not all(isinstance(kind, str) for kind in goals):
        return "whose Goals is no set of names", "write frozenset({name})"
    if unknown := sorted(goals - set(commands)):
        return (
            f"whose goal {', '.join(unknown)} is none of its Commands",
            f"name some of {', '.join(commands) or 'them: it has no Commands'}",
        )
    if goals and controller.on_goal is Controller.on_goal:
        return "which has Goals and no method on_goal", "write it"
    return None
