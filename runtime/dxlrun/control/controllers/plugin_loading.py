"""Plug-ins: find the installed packages that offer controllers, and check them against the contract.

Plug-ins are checked when they are loaded. Their authors get one sentence with a fix, and runs do not fail
with a traceback. A broken plug-in does not affect the other ones. The checks cover methods, their arguments,
and the types of declared attributes.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, Never, TypeAlias, TypeVar, cast

import msgspec
import pluggy
from msgspec.structs import asdict
from pydantic import ValidationError

from dxlrun.contract.controller import CommandModel, Controller, Interfaces, Mismatch, RobotModel
from dxlrun.contract.hookspecs import CONTRACT_VERSION, HookSpecs
from dxlrun.contract.joint_controller import LAWS, JointController, laws_of
from dxlrun.control.controllers.offers import Breach, DriverOffer, OfferStage, is_model, methods_breach
from dxlrun.control.controllers.single_files import class_in_file, file_of, publisher_of
from dxlrun.description.base_form import ParametersModel
from dxlrun.errors import ControllerFault, PlugInError
from dxlrun.features import FEATURES, broken_features, stages
from dxlrun.features.feature import SolvedPose
from dxlrun.installed_plugins import GROUP, InstalledPlugin, distribution_name, installed_plugins
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan
from dxlsim.motor_model import MotorModel
from dxlwire.control_table import add_control_table
from dxlwire.control_table.device_models import add_device_table
from dxlwire.control_table.device_table import is_device_table
from dxlwire.modes import mode_of

_MOST_MISTAKES = 5
ControllerClass = type[Controller[Any]]

_METHODS = (
    "__init__",
    "interfaces",
    "mismatches",
    "motions",
    "prepare",
    "speed_peaks",
    "on_configure",
    "on_activate",
    "on_restart",
    "on_command",
    "on_goal",
    "on_cancel",
    "on_parameters",
    "on_hold",
    "update",
    "on_deactivate",
)
"""Controller methods that dxlrun calls with positional arguments, which are checked against the base class.
"""
_DECLARED = {
    "Commands": (dict[str, type], "write {name: class of dxlrun.CommandModel}"),
    "Goals": (frozenset[str], "write frozenset({name})"),
    "Topics": (dict[str, type], 'write Topics = {"state": WaveState}'),
    "publishes": (tuple[str, ...], 'write publishes = ("/joint_states",)'),
}
"""Class attributes of a controller, each with its required type and an example as the fix."""
_HOOKS = tuple(name for name in vars(HookSpecs) if name.startswith("dxlrun_"))
_NO_FILES: Mapping[str, str] = MappingProxyType({})
Decide: TypeAlias = Callable[[int, int, int], object]
"""Function of a plug-in that implements its hook `dxlrun_overrun`: cycle, scheduled_ns, actual_ns -> policy
or None.
"""


class OverrunHook(msgspec.Struct, frozen=True):
    """Hook of one plug-in that chooses the policy for late cycles."""

    plugin: str
    """Name of the plug-in's entry point, with its distribution in brackets."""
    decide: Decide


class Offer(msgspec.Struct, frozen=True):
    """A controller class that a plug-in offers."""

    type: str
    """Name of the controller class in the robot file, `type:`."""
    controller: ControllerClass
    distribution: str
    """Python package that offers the class: `name version`."""


Refuse: TypeAlias = Callable[[str, str], PlugInError]
"""Makes the PlugInError of one plug-in from a problem and its fix."""
Offered = TypeVar("Offered", Offer, DriverOffer)
Result = TypeVar("Result")
Make: TypeAlias = Callable[[], Offered]
"""Imports and checks a class that a plug-in offers; raises PlugInError."""


def _nothing_else(name: str) -> Never:
    raise KeyError(name)


class Offers(Mapping[str, Offered]):
    """Classes that plug-ins offer, by type name. One named by an import path is imported on first access.

    If the import fails, the type is removed and `broken` has the reason.

    Args:
        makes: Functions that import and check the classes, by type.
        broken: Receives the error messages, by type.
        unlisted: Makes the offer for a type not in `makes`, such as one in a single file, or raises KeyError.
    """

    def __init__(
        self,
        makes: Mapping[str, Make[Offered]],
        broken: dict[str, str],
        unlisted: Callable[[str], Offered] = _nothing_else,
    ) -> None:
        self._makes: dict[str, Make[Offered]] = dict(makes)
        self._unlisted: Callable[[str], Offered] = unlisted
        self._made: dict[str, Offered] = {}
        self._broken = broken

    def __getitem__(self, name: str) -> Offered:
        if name not in self._made:
            make = self._makes.get(name) or partial(self._unlisted, name)
            try:
                self._made[name] = make()
            except PlugInError as error:
                self._makes.pop(name, None)
                self._broken[name] = str(error)
                raise KeyError(name) from error
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(tuple(self._makes))

    def __len__(self) -> int:
        return len(self._makes)


class LoadedPlugIn(msgspec.Struct, frozen=True):
    """A plug-in whose entry point was imported and checked without errors."""

    name: str
    """Name of its entry point."""
    distribution: str
    """Python package of the plug-in: `name version`."""
    package: str
    """Top-level Python module of its entry point."""
    contract: int
    """Version of dxlrun's plug-in contract that it was written for."""
    controllers: Mapping[str, Make[Offer]]
    """Functions that import and check its controller classes, by type name."""
    servo_models: tuple[str, ...]
    overrun: Decide | None
    """Its hook for late cycles; None: not implemented."""
    drivers: Mapping[str, Mapping[str, Make[DriverOffer]]]
    """Functions that import and check its classes for features, by feature and type name."""
    verbs: tuple[str, ...]
    """Names of the commands that it adds to the command line."""


def _any_threads(name: str) -> None:
    """Do nothing: processes without a loop may have threads."""


class PlugIns(msgspec.Struct, frozen=True):
    """All installed plug-ins: controllers and drivers that they offer, and reasons why some are broken."""

    controllers: Mapping[str, Offer]
    """Offered controller classes by type name."""
    broken: Mapping[str, str]
    """Sentences about errors: by entry point for each broken plug-in, by type name for a type that two
    plug-ins offer or that cannot be imported.
    """
    loaded: tuple[LoadedPlugIn, ...] = ()
    """Plug-ins without errors, in load order."""
    after_each: Callable[[str], None] = _any_threads
    """Called with a name after plug-in code was imported or configured, to count threads. May raise
    PlugInError."""
    drivers: Mapping[str, Mapping[str, DriverOffer]] = msgspec.field(default_factory=dict)
    """Offered classes for the sections of features, such as sensors, by feature and type name."""

    @property
    def overrun_hooks(self) -> tuple[OverrunHook, ...]:
        """Hooks of all plug-ins for late cycles, in the order in which they are called."""
        return tuple(
            OverrunHook(f"{one.name} ({one.distribution})", one.overrun)
            for one in self.loaded
            if one.overrun is not None
        )

    def drivers_of(self, feature: str) -> Mapping[str, DriverOffer]:
        """Return the classes that plug-ins offer for entries of a feature's section, by type name."""
        return self.drivers.get(feature, {})

    def parameters_of_drivers(self, feature: str, publisher: str = "") -> dict[str, type[ParametersModel]]:
        """Return the parameter models of the classes offered for a feature's section, by type name.

        Args:
            feature: Name of the feature.
            publisher: Prefix of `name version` of the packages to include; empty: all packages.
        """
        offers = self.drivers_of(feature)
        return {
            name: offer.driver.Parameters
            for name in offers
            if (offer := offers.get(name)) and offer.distribution.startswith(publisher)
        }

    def packages_of(self, controllers: Sequence[ControllerPlan], models: Container[str]) -> dict[str, str]:
        """Return the Python packages whose code runs in a robot: distribution name by top-level module.

        These are the packages that offer its controllers or servo models, the packages of the classes if they
        differ, and the packages with an overrun hook.

        Args:
            controllers: Controllers of the robot.
            models: Names of the robot's servo models.
        """
        types = {one.type: one.distribution for one in controllers}
        offering = [
            one
            for one in self.loaded
            if types.keys() & one.controllers.keys()
            or one.overrun is not None
            or any(model in models for model in one.servo_models)
        ]
        # A single file belongs to no package. The hash in its name identifies its version.
        classes = {kind: self.controllers[kind].controller for kind in types if file_of(kind) is None}
        return self._name_packages(offering, classes, types)

    def packages_of_drivers(self, feature: str, types: Mapping[str, str]) -> dict[str, str]:
        """Return the Python packages of a feature's classes: distribution name by top-level module.

        Args:
            feature: Name of the feature.
            types: Distributions (`name version`) of the classes in use, by type name.
        """
        offering = [one for one in self.loaded if types.keys() & one.drivers.get(feature, {}).keys()]
        classes = {kind: self.drivers_of(feature)[kind].driver for kind in types}
        return self._name_packages(offering, classes, types)

    def _name_packages(
        self,
        offering: Sequence[LoadedPlugIn],
        classes: Mapping[str, type[Any]],
        publishers: Mapping[str, str],
    ) -> dict[str, str]:
        found = {one.package: one.distribution for one in offering}
        known = {one.package: one.distribution for one in self.loaded}
        for kind, made in classes.items():
            package = _top(made.__module__)
            found.setdefault(package, known.get(package, publishers[kind]))
        return {package: distribution_name(publisher) for package, publisher in sorted(found.items())}

    def import_all(self) -> None:
        """Import all offered controller classes now.

        An import in a running loop would take longer than a cycle.
        """
        for name in self.controllers:
            if self.controllers.get(name) is not None:
                self.after_each(name)

    def built(self, plan: ControllerPlan) -> Controller[Any]:
        """Return a new controller of the plan's type, with the plan's parameters.

        Raises: PlugInError: The type is not available, or its parameters are not valid. ControllerFault: The
        class raised.
        """
        offer = self.controllers.get(plan.type)
        if offer is None:
            raise self.unknown_type(f"controller {plan.name}", plan.type)
        try:
            parameters = offer.controller.Parameters.model_validate_json(plan.parameters)
            return offer.controller(parameters)
        except ValidationError as error:
            from dxlrun.description.form_problems import sentences_of

            wrong = "; ".join(sentences_of(error, plan.name, offer.controller.Parameters, _MOST_MISTAKES))
            raise PlugInError(f"wrong controller parameters: {wrong}") from error
        except (Exception, SystemExit) as error:  # foreign code: one sentence instead of its traceback
            raise ControllerFault(
                f"controller {plan.name} cannot be built: {type(error).__name__}: {error}"
            ) from error

    def unknown_type(self, what: str, kind: str) -> PlugInError:
        """Return the error for an entry `what` of the robot file whose type `kind` no plug-in offers."""
        why = f" ({'; '.join(self.broken.values())})" if self.broken else ""
        return PlugInError(f"no plug-in offers the type {kind} of {what}{why}")


def load_plugins(
    after_each: Callable[[str], None] = _any_threads, files: Mapping[str, str] = _NO_FILES
) -> PlugIns:
    """Import all installed plug-ins (entry points `dxlrun`); return their classes and the errors.

    Raises only exceptions of `after_each`.

    Args:
        after_each: Called with the plug-in's name and distribution after each import, broken or not, and
            later after each configuration of a controller. The loop's process counts its threads there.
        files: Texts of single files by name. Their classes are offered as `./wave.py:Wave`.
    """
    broken: dict[str, str] = {}
    loaded: list[LoadedPlugIn] = []
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(HookSpecs)
    for plugin in sorted(installed_plugins(), key=lambda each: each.publisher):
        named = f"{plugin.name} ({plugin.publisher})"
        try:
            loaded.append(_load(plugin, manager))
        except PlugInError as error:
            broken[plugin.name if plugin.name not in broken else named] = str(error)
        after_each(named)
    broken = {**broken_features(), **broken}  # after the loop: this imports every plug-in
    controllers = _together("controller", [(one.distribution, one.controllers) for one in loaded], broken)
    drivers = {
        feature.name: Offers(
            _together(stage.kind, [(one.distribution, one.drivers[feature.name]) for one in loaded], broken),
            broken,
        )
        for feature, stage in stages(OfferStage, FEATURES)
    }
    offers = Offers(controllers, broken, partial(_offer_of_file, files))
    return PlugIns(offers, broken, tuple(loaded), after_each, drivers)


def _offer_of_file(files: Mapping[str, str], name: str) -> Offer:
    """Return the offer of a controller class in a single file. Raises KeyError for types without a file.

    Raises PlugInError for a broken class.
    """
    controller, file = class_in_file(name, files), file_of(name) or ""

    def make_error(what: str, fix: str) -> PlugInError:
        return PlugInError(f"{file} {what}; {fix}")

    return _offer(publisher_of(file, files[file]), make_error, name, controller)


def _together(
    what: str, offered: Sequence[tuple[str, Mapping[str, Make[Offered]]]], broken: dict[str, str]
) -> dict[str, Make[Offered]]:
    """Merge the classes that several plug-ins offer. A type that two of them offer is moved to `broken`."""
    made: dict[str, Make[Offered]] = {}
    publishers: dict[str, str] = {}
    twice: dict[str, str] = {}
    for publisher, types in offered:
        for name in types:
            if (first := publishers.setdefault(name, publisher)) != publisher or name in made:
                twice[name] = (
                    f"{first} and {publisher} both offer a {what} of type {name}, so neither is used: "
                    "uninstall one of them, or ask an author to rename it"
                )
        made |= types
    broken |= twice
    return {name: make for name, make in made.items() if name not in twice}


def _top(module: str) -> str:
    return module.partition(".")[0]


def _one_line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _load(plugin: InstalledPlugin, manager: pluggy.PluginManager) -> LoadedPlugIn:
    """Import and check one plug-in. Raises PlugInError with one sentence that names its distribution.

    The plug-in is registered with `manager` only in this call, so that each hook is called for it alone.
    """
    publisher = plugin.publisher

    def make_error(what: str, fix: str) -> PlugInError:
        return PlugInError(f"plug-in {plugin.name} of {publisher} {what}; {fix}")

    module = _asked(make_error, "cannot be imported", plugin.point.load, "reinstall it, or ")
    unmarked = [name for name, hook in _functions(module) if not hasattr(hook, f"{GROUP}_impl")]
    if unmarked:
        what = f"has an unmarked hook {unmarked[0]}"
        raise make_error(what, "put @dxlrun.hookimpl above this function")
    try:
        # The errors of pluggy name hooks that do not exist and wrong arguments.
        _asked(make_error, "has an invalid hook", partial(manager.register, module, plugin.name))
        _asked(make_error, "has an invalid hook", manager.check_pending)
        contracts, controllers, servo_models, commands = (
            _asked(make_error, "raised in a hook", getattr(manager.hook, f"dxlrun_{name}"))
            for name in ("contract", "controllers", "servo_models", "commands")
        )
        offered = {
            feature.name: (stage, _asked(make_error, "raised in a hook", getattr(manager.hook, stage.hook)))
            for feature, stage in stages(OfferStage, FEATURES)
        }
        overrun = _overrun(manager)
    finally:
        if manager.is_registered(module):
            manager.unregister(module)
    if not contracts:
        raise make_error("does not declare its contract", "it must implement the hook dxlrun_contract")
    contract = contracts[0]
    if not (type(contract) is int and 1 <= contract <= CONTRACT_VERSION):
        raise make_error(
            f"was written for contract {contract!r}, but this dxlrun has contract {CONTRACT_VERSION}",
            "install a matching version",
        )
    return LoadedPlugIn(
        plugin.name,
        publisher,
        _top(plugin.point.module),
        contract,
        dict(_makes(controllers, "dxlrun_controllers", make_error, partial(_offer, publisher, make_error))),
        tuple(name for models in servo_models for name in _add_servo_models(models, make_error)),
        overrun,
        {
            name: dict(
                _makes(found, stage.hook, make_error, partial(_driver_offer, stage, publisher, make_error))
            )
            for name, (stage, found) in offered.items()
        },
        tuple(str(verb.name) for added in commands for verb in added),
    )


def _asked(refuse: Refuse, what: str, call: Callable[[], Result], also: str = "") -> Result:
    """Call plug-in code and return its result; convert exceptions to the PlugInError that `refuse` makes."""
    try:
        return call()
    except (Exception, SystemExit) as error:
        raise refuse(f"{what} ({_one_line(error)})", f"{also}report it to its author") from error


def _functions(module: object) -> Iterator[tuple[str, object]]:
    """Yield name and function of each hook, `dxlrun_...`, that a plug-in's module defines."""
    for name in _HOOKS:
        hook = getattr(module, name, None)
        if callable(hook):
            yield name, hook


def _makes(
    mappings: Sequence[object], hook: str, refuse: Refuse, offer: Callable[[str, object], Offered]
) -> Iterator[tuple[str, Make[Offered]]]:
    """Yield each type name that a hook returned, with the function that makes its offer.

    A class is checked at once. An import path is imported and checked later.
    """
    for mapping in mappings:
        if not isinstance(mapping, Mapping) or not all(isinstance(name, str) for name in mapping):
            raise refuse(f"does not return a mapping of names from {hook}", "return {type: class}")
        for name, kind in mapping.items():
            if isinstance(kind, str):
                yield name, partial(_imported, name, kind, refuse, offer)
            else:
                yield name, partial(_itself, offer(name, kind))


def _itself(made: Offered) -> Offered:
    return made


def _imported(name: str, place: str, refuse: Refuse, offer: Callable[[str, object], Offered]) -> Offered:
    module, _, attribute = place.partition(":")
    what = f"offers {name}, but {place} cannot be imported"
    return offer(name, _asked(refuse, what, lambda: getattr(import_module(module), attribute)))


def _overrun(manager: pluggy.PluginManager) -> Decide | None:
    """Return a function that calls a plug-in's `dxlrun_overrun` with the arguments that it declares.

    None without.
    """
    found = manager.hook.dxlrun_overrun.get_hookimpls()
    return partial(_call, found[0].function, found[0].argnames) if found else None


def _call(
    function: Callable[..., object], names: Sequence[str], cycle: int, scheduled_ns: int, actual_ns: int
) -> object:
    given = {"cycle": cycle, "scheduled_ns": scheduled_ns, "actual_ns": actual_ns}
    return function(**{name: given[name] for name in names})


def _add_servo_models(models: object, refuse: Refuse) -> list[str]:
    """Register the control tables of a plug-in in this process; return the names of the models.

    One hook returns servos and devices. The text of a table identifies its kind.
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
                f"offers an unusable servo model {where}({_one_line(error)})",
                "report it to its author",
            ) from error
        names.append(table.model)
    return names


def _driver_offer(
    stage: OfferStage, publisher: str, refuse: Refuse, name: str, driver: object
) -> DriverOffer:
    _check(stage.find_breach(driver), driver, name, refuse)
    return DriverOffer(name, cast("type[Any]", driver), publisher)


def _offer(publisher: str, refuse: Refuse, name: str, controller: object) -> Offer:
    _check(controller_breach(controller), controller, name, refuse)
    return Offer(name, cast("ControllerClass", controller), publisher)


def _check(breach: Breach | None, kind: object, name: str, refuse: Refuse) -> None:
    if breach is not None:
        what, fix = breach
        shown = kind.__qualname__ if isinstance(kind, type) else repr(kind)
        raise refuse(f"offers {shown} as {name}: {what}", fix)


# The contract


def controller_breach(controller: object) -> Breach | None:
    """Check a class that is offered as a controller; return the first violation of the contract, or None."""
    if not (isinstance(controller, type) and issubclass(controller, Controller)):
        return "it is not a controller", "derive it from dxlrun.Controller"
    if breach := methods_breach(controller, Controller, _METHODS) or _laws_breach(controller):
        return breach
    if not is_model(controller.Parameters, ParametersModel):
        return "its Parameters is not a parameters model", "derive it from dxlrun.ParametersModel"
    for name, (kind, fix) in _DECLARED.items():
        try:
            msgspec.convert(getattr(controller, name), kind)
        except msgspec.ValidationError as error:
            return f"its {name} has the wrong type: {error}", fix
    return _commands_breach(controller) or _topics_breach(controller.Topics)


def _laws_breach(controller: ControllerClass) -> Breach | None:
    if not issubclass(controller, JointController):
        return None
    if not laws_of(controller):
        return f"it has no method {', '.join(LAWS)}", "write `def positions(self, time, dt):`"
    return methods_breach(controller, JointController, ("begin", *LAWS))


def _commands_breach(controller: ControllerClass) -> Breach | None:
    commands, goals = controller.Commands, controller.Goals
    if wrong := [kind for kind, model in commands.items() if not is_model(model, CommandModel)]:
        return f"its command {wrong[0]} is not a command model", "derive it from dxlrun.CommandModel"
    if goals and controller.on_goal is Controller.on_goal:
        return "it has Goals, but no method on_goal", "add the method"
    return None


def _topics_breach(topics: Mapping[str, type]) -> Breach | None:
    if not topics:
        return None
    # Imported here because few controllers publish messages.
    from dxlrun.messages.declared import WrongMessage, declared_message

    for topic, message in topics.items():
        try:
            declared_message(message, "any")
        except WrongMessage as wrong:
            return f"its topic {topic} has no ROS 2 message: {wrong.what}", wrong.fix
    return None


def interfaces_breach(interfaces: object, *, chained: bool = False) -> Breach | None:
    """Check the result of a controller's `interfaces`; return the first problem, or None.

    Args:
        interfaces: The result.
        chained: True if the controller commands references, which allow any combination of interfaces. The
            modes of servos allow only some.
    """
    if not isinstance(interfaces, Interfaces):
        return f"returns {interfaces!r} from interfaces", "return dxlrun.Interfaces(joints, command)"
    if breach := _names_breach(interfaces):
        return breach
    try:
        mode_of(("position",) if chained else interfaces.command or ("position",))
    except ValueError as error:
        return (
            f"requests incompatible command interfaces: {error}",
            "request position (alone, or with velocity or effort), or velocity, effort or pwm alone",
        )
    return None


def _names_breach(interfaces: Interfaces) -> Breach | None:
    fix = "write tuples of names, as in dxlrun.Interfaces"
    try:
        asked = msgspec.convert(asdict(interfaces), Interfaces)
    except msgspec.ValidationError as error:
        return f"returns wrong interfaces: {error}", fix
    if asked != interfaces:
        return "returns lists in its interfaces", fix
    if wrong := [name for name in interfaces.provides if not name or "/" in name]:
        return f"provides {', '.join(map(repr, wrong))}", "choose names without `/`, such as orientation.x"
    if unread := [name for name in interfaces.optional if name not in interfaces.reads]:
        return f"has optional reads that it does not read: {', '.join(unread)}", "list them in reads, too"
    figures = MotorModel.__struct_fields__
    if strange := [name for name in interfaces.motors if name not in figures]:
        return f"needs unknown motor data: {', '.join(strange)}", f"choose from {', '.join(figures)}"
    return None


def motor_breach(needed: Sequence[str], joint: JointPlan) -> Breach | None:
    """Return the problem if a joint's motor model lacks figures that a controller needs, else None."""
    identify = f"measure it with `dxlrun identify {joint.name}`, and write the new file"
    if needed and joint.motor is None:
        return (
            f"needs the motor of {joint.name}, but {joint.name} has no motor file",
            f"{identify}: `motor: {joint.name}.motor.yaml` at the joint",
        )
    lacking = [name for name in needed if getattr(joint.motor, name) is None]
    if "torque_per_effort" in lacking:
        what = f"needs the torque of {joint.name}, but its servo measures neither torque nor current"
        return what, "command positions or PWM instead"
    if lacking:
        return f"needs the {', '.join(lacking)} of {joint.name}, missing in its motor file", identify
    return None


def mismatches(
    controller: ControllerClass,
    parameters: ParametersModel,
    motors: Sequence[str],
    joints: Sequence[JointPlan],
    robot: RobotModel,
) -> list[Mismatch]:
    """Return the reasons why a controller does not suit a robot.

    Exceptions of the controller pass through.

    Args:
        controller: Class of the controller; its `mismatches` is called if no figure of a motor is missing.
        parameters: Parameters of the controller.
        motors: Figures that the controller needs of each motor.
        joints: Joints of the controller.
        robot: Robot of the controller.
    """
    lacking = [(joint.name, motor_breach(motors, joint)) for joint in joints]
    if found := [Mismatch(*breach, name) for name, breach in lacking if breach is not None]:
        return found
    return list(controller.mismatches(parameters, robot))


def robot_model(
    own: Sequence[JointPlan], joints: Iterable[str], urdf: str | None, poses: Mapping[str, SolvedPose]
) -> RobotModel:
    """Return a controller's view of its robot, from its own joints, the names of all, URDF and poses."""
    names = tuple(joint.name for joint in own)
    return RobotModel(
        names,
        tuple(joint.servo_model for joint in own),
        tuple(joint.motor for joint in own),
        tuple(joint.unit for joint in own),
        urdf,
        tuple(name for name in joints if name not in names),
        poses,
    )
