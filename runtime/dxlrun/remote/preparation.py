"""Preparation: checks commands of clients against the robot's plan and converts them to the loop's arrays.

All plug-in code that a client can reach runs here, in the gateway's process, never in the loop's.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import msgspec
import numpy as np
from msgspec.structs import replace
from pydantic import BaseModel, TypeAdapter, ValidationError

from dxlrun.channels.answers import Code, Field, Refusal
from dxlrun.compile.controller_entry import (
    CompiledController,
    WrongEntry,
    compile_entry,
    find_offer,
    plan_entry,
    require_fit,
)
from dxlrun.compile.controller_graph import ControllerGraph, Mistake
from dxlrun.compile.joints.limits import LimitViolation, beyond_limits
from dxlrun.compile.joints.poses import Poses, pose_places
from dxlrun.compile.motions import TRAJECTORY
from dxlrun.control.controllers.plugin_loading import (
    ControllerClass,
    PlugIns,
    load_plugins,
    robot_model,
)
from dxlrun.control.controllers.update_order import rate_divider, rate_fits
from dxlrun.description.base_form import Name, ParametersModel
from dxlrun.description.form_problems import sentences_of
from dxlrun.description.joints.groups import Groups, without_groups
from dxlrun.description.robot import ControllerEntry
from dxlrun.description.units import (
    angle,
    angular_acceleration,
    angular_velocity,
    duration,
    length,
    linear_acceleration,
    linear_velocity,
)
from dxlrun.errors import suggestion, what_and_fix
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan, ServoLimit, SourcePlan
from dxlrun.plan.robot_plan import Plan
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit

BODY_TOO_DEEP = "the body is nested too deeply; use fewer levels"
LONGEST_NAME = 64
"""Upper limit of the name of a controller that a client loads, characters; the log truncates longer names."""
BUDGET_S = 5.0
"""Timeout, s, of the plug-in code that one request runs.

All other clients wait for it, even to send `stop`.
"""
_MOST_MISTAKES = 5
_LONGEST_SENTENCE = 300
_MOST_QUANTITIES = 20
"""Upper limit of the wrong quantities that a refusal lists."""
_NAME: TypeAdapter[str] = TypeAdapter(Name)
GROUP_FIELDS: Mapping[str, str] = {
    "position": "positions",
    "velocity": "velocities",
    "effort": "efforts",
    "pwm": "pwm",
}
"""Interface -> field of the commands of group controllers, which has a value for each joint."""


class RefusedRequest(Exception):
    """A request that the gateway or the loop refused; `refusal` has code and fields."""

    def __init__(self, refusal: Refusal) -> None:
        super().__init__(refusal.text)
        self.refusal = refusal


def refused(code: Code, fields: Mapping[str, Field]) -> RefusedRequest:
    """Return the exception for a refusal with this code and fields."""
    return RefusedRequest(Refusal(code, fields))


def travel_s(joint: JointPlan, distance: float, speed: float) -> float:
    """Return the time, s, that a joint needs for a distance at a speed.

    Returns 0 at speed 0 when the distance is within the joint's goal tolerance.

    Raises:
        RefusedRequest: The speed is 0 because a register of the servo keeps the joint from moving.
    """
    if speed:
        return distance / speed
    if distance <= joint.goal_tolerance:
        return 0.0
    raise invalid(f"{joint.immovable}; set the register above 0")


def invalid(problem: str) -> RefusedRequest:
    """Return the exception for an input that would be refused in any state of the robot."""
    return refused(Code.INVALID, {"problem": problem})


class _PlugInTimeout(BaseException):
    """A plug-in's code exceeded BUDGET_S; not an Exception, which the plug-in could catch."""


@contextmanager
def bounded(controller: str) -> Iterator[None]:
    """Limit the Python code of a `with` block to BUDGET_S; raises RefusedRequest that names `controller`
    after it.

    Only in the main thread. A call into C that never returns is not interrupted; then only Ctrl-C helps.
    """

    def interrupt(*_: object) -> None:
        raise _PlugInTimeout

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, BUDGET_S)
    try:
        yield
    except _PlugInTimeout:
        raise refused(Code.TOO_SLOW, {"controller": controller, "seconds": BUDGET_S}) from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def plugin_code(controller: str, where: str, model: type[BaseModel] | None = None) -> Iterator[None]:
    """Run a plug-in's code with a time limit; its exceptions become a RefusedRequest that begins with
    `where`.

    `model`: type of a validated input, whose mistakes are listed one by one.
    """
    try:
        with bounded(controller):
            yield
    except RefusedRequest:
        raise
    # A plug-in refuses an input with ValueError.
    except ValueError as error:
        if isinstance(error, ValidationError) and model is not None:
            raise invalid(mistakes(error, where, model)) from error
        raise invalid(f"{where}: {_one_line(str(error))}") from error
    # A bug of the plug-in.
    except (Exception, SystemExit) as error:
        raise invalid(f"{where}: {_one_line(f'{type(error).__name__}: {error}')}") from error


@dataclass(frozen=True, slots=True)
class PreparedCommand:
    """A controller's command in the form that the loop reads, with the result of the check of limits."""

    controller: str
    kind: str
    data: bytes
    """Array that the controller's class prepared, little-endian float64."""
    beyond: tuple[LimitViolation, ...]
    """Values of the command that are beyond the limits of their joints."""
    request: bytes = b""
    """The command as JSON in SI units, for the log."""

    @property
    def joints_beyond(self) -> tuple[str, ...]:
        """Names of the joints with a value beyond their limits, without repeats."""
        return tuple(dict.fromkeys(one.joint for one in self.beyond))

    def require_within_limits(self) -> None:
        """Raise RefusedRequest when a value is beyond its joint's limits."""
        if self.beyond:
            left = len(self.beyond) - _MOST_MISTAKES
            more = f"; and {left} more" if left > 0 else ""
            problem = "; ".join(one.text for one in self.beyond[:_MOST_MISTAKES]) + more
            fields: dict[str, Field] = {"controller": self.controller, "kind": self.kind}
            raise refused(Code.BEYOND_LIMITS, fields | {"joints": self.joints_beyond, "problem": problem})


@dataclass(frozen=True, slots=True)
class ResolvedController:
    """A controller's plan with its class, parameters and joints, kept for its next commands."""

    plan: ControllerPlan
    controller: ControllerClass
    parameters: ParametersModel
    joints: tuple[JointPlan, ...]


@dataclass(frozen=True, slots=True)
class Preparation:
    """Checks and conversions of commands, with the robot's joints and the plug-ins' controller classes."""

    joints: dict[str, JointPlan]
    """Joint plans of the robot by name, in the robot's order."""
    plugins: PlugIns
    sources: tuple[SourcePlan, ...] = ()
    """Devices and sensors of the robot, whose states controllers can read."""
    urdf: str | None = None
    """Text of the robot's URDF."""
    groups: Groups = field(default_factory=dict)
    """Names of groups of joints in the robot file, with their joints."""
    omitted: tuple[str, ...] = ()
    """Joints of the robot file that the run omits."""
    poses: Poses = field(default_factory=Poses)
    _known: dict[str, ResolvedController] = field(default_factory=dict, init=False)
    """Cache of `known`, by controller name; not used when a controller of that name has another plan now."""
    _schemas: dict[str, dict[str, object]] = field(default_factory=dict, init=False)
    """Cache of `takes`: controller type -> command -> JSON Schema."""

    @classmethod
    def from_plan(cls, plan: Plan) -> Preparation:
        """Return the preparation of a robot's commands by its plan and the installed plug-ins."""
        loop, plugins = plan.loop, load_plugins(files=plan.included)
        joints = {joint.name: joint for joint in loop.joints}
        poses = Poses(plan.poses, joints, plan.omitted, plan.urdf)
        return cls(joints, plugins, loop.sources, plan.urdf, plan.groups, plan.omitted, poses)

    def take_servo_limits(self, joint: str, limits: tuple[ServoLimit, ...]) -> None:
        """Store the registers that limit a joint's servo, so that commands are checked against them."""
        if joint in self.joints:
            self.joints[joint] = replace(self.joints[joint], servo_limits=limits)
            self._known.clear()

    def takes(self, plan: ControllerPlan) -> dict[str, object]:
        """Return the JSON Schema of each command that a controller accepts; a schema is empty when the
        plug-in fails.
        """
        if plan.type not in self._schemas:
            offer = self.plugins.controllers.get(plan.type)
            commands = offer.controller.Commands if offer else {}
            try:
                found: dict[str, object] = {k: model.model_json_schema() for k, model in commands.items()}
            # The plug-in's code failed; its commands can be sent without a schema.
            except (Exception, SystemExit):
                found = {kind: {} for kind in commands}
            self._schemas[plan.type] = found
        return self._schemas[plan.type]

    def compiled(self, plan: ControllerPlan) -> CompiledController:
        """Return a controller's plan with its offer and parsed parameters; raises RefusedRequest for wrong
        parameters.
        """
        known = self._known.get(plan.name)
        same = known is not None and known.plan.parameters == plan.parameters and known.plan.type == plan.type
        parameters = (
            known.parameters if known is not None and same else self.parse_controller(plan).parameters
        )
        return CompiledController(plan, self.plugins.controllers[plan.type], parameters)

    def goals(self, plan: ControllerPlan) -> list[str]:
        """Return the names of a controller's commands that are goals: they run for a time and report a
        result.
        """
        offer = self.plugins.controllers.get(plan.type)
        return sorted(offer.controller.Goals) if offer else []

    def motions(self, plan: ControllerPlan) -> dict[str, float | None]:
        """Return a controller's motions with durations, s, by name; None: until it is cancelled.

        Empty when the plug-in's code fails.
        """
        try:
            known = self.parse_controller(plan)
            with bounded(plan.name):
                found = known.controller.motions(known.parameters)
                return {name: seconds if math.isfinite(seconds) else None for name, seconds in found.items()}
        # The plug-in's code failed; other controllers are still shown.
        except (Exception, SystemExit):
            return {}

    def parameters(self, plan: ControllerPlan) -> ParametersModel:
        """Return the parsed parameters in a controller's plan; raises RefusedRequest."""
        return self.parse_controller(plan).parameters

    def command(
        self, plan: ControllerPlan, kind: str, body: bytes, *, units: bool = False
    ) -> PreparedCommand:
        """Check a controller's command in JSON and convert it for the loop (`true` and "1" are not numbers
        there).

        Args:
            plan: Plan of the controller.
            kind: Name of the command.
            body: JSON of the command.
            units: The quantities are texts with units, if motions can use this command.

        Returns:
            The prepared command, which can have values beyond limits.

        Raises:
            RefusedRequest: The command is unknown, or its values are invalid.
        """
        known = self.parse_controller(plan)
        controller = known.controller
        model = controller.Commands.get(kind)
        if model is None:
            kinds = tuple(controller.Commands)
            fields: dict[str, Field] = {"controller": plan.name, "kind": kind, "known": kinds}
            takes = suggestion(kind, (*kinds, *joint_quantities(controller.Commands)))
            hint = f"a cartesian_controller takes poses; {takes}" if kind == "pose" else takes
            raise refused(Code.UNKNOWN_COMMAND, fields | {"hint": hint})
        what = f"{kind} of {plan.name}"
        if units and _of_motions(kind, model):
            body = in_si(body, what, known.joints)
        if pose_places(model):
            with suppress(msgspec.MsgspecError, RecursionError):  # refused with the other mistakes
                body = msgspec.json.encode(self._posed(msgspec.json.decode(body), plan.name, what, model))
        with plugin_code(plan.name, what, model):
            command = model.model_validate_json(body, strict=True)
            prepared = controller.prepare(kind, command, known.parameters)
            robot = robot_model(known.joints, self.joints, self.urdf, self.poses.named)
            controller.check_command(kind, command, known.parameters, robot)
            data = np.ascontiguousarray(prepared, dtype="<f8").tobytes()
            peaks = controller.speed_peaks(kind, np.frombuffer(data, "<f8"), known.parameters)
            beyond = tuple(beyond_limits(known.joints, command, peaks))
        return PreparedCommand(plan.name, kind, data, beyond, body)

    def _posed(self, written: object, controller: str, what: str, model: type[BaseModel]) -> object:
        """Return data of a model with positions in place of poses; raise RefusedRequest."""
        with plugin_code(controller, what):  # Features solve poses
            posed, wrong = self.poses.put_in(written, model)
        if wrong:
            raise invalid(
                "; ".join(f"{what}: {problem}; {fix}" for _, problem, fix in wrong[:_MOST_MISTAKES])
            )
        return posed

    def parse_controller(self, plan: ControllerPlan) -> ResolvedController:
        """Return a controller's class, parsed parameters and joints, from the cache if the plan is the same.

        Raises RefusedRequest for a type without a plug-in, or wrong parameters.
        """
        known = self._known.get(plan.name)
        if known is not None and known.plan is plan:
            return known
        offer = self.plugins.controllers.get(plan.type)
        if offer is None:
            raise invalid(
                f"the plug-in with the type {plan.type} of {plan.name} is missing; install it again"
            )
        with plugin_code(plan.name, f"the parameters of {plan.name}"):
            parameters = offer.controller.Parameters.model_validate_json(plan.parameters)
        joints = tuple(self.joints[joint] for joint in plan.joints)
        known = self._known[plan.name] = ResolvedController(plan, offer.controller, parameters, joints)
        return known

    def controller(
        self, entry: Mapping[str, object], others: Mapping[str, ControllerPlan], rate: float
    ) -> ControllerPlan:
        """Check the entry of a controller to be loaded in addition to `others`, and return its plan,
        inactive.

        `entry` is an entry of the robot file with its `name`; `rate` is the loop's rate, Hz. Raises
        RefusedRequest.
        """
        try:
            name = _NAME.validate_python(entry.get("name", ""))
            own = without_groups({k: v for k, v in entry.items() if k != "name"}, self.groups)
            written = ControllerEntry.model_validate(own)
        except ValidationError as error:
            raise invalid(mistakes(error, "the controller's entry", ControllerEntry)) from error
        if len(name) > LONGEST_NAME:
            raise invalid(f"a name has at most {LONGEST_NAME} characters; choose a shorter one")
        if name in others:
            raise refused(
                Code.NAME_TAKEN,
                {"controller": name, "hint": "choose another name, or unload that controller"},
            )
        if entry.get("active"):
            raise invalid(f"controllers are loaded inactive; load {name} first, then switch to it")
        if (offer := self.plugins.controllers.get(written.type)) is not None:
            parameters = self._posed(written.parameters, name, name, offer.controller.Parameters)
            written = written.model_copy(update={"parameters": parameters})
        # The divider is 1 here; the loop computes it for its own rate.
        plan = self._compiled(replace(plan_entry(name, written, every=1), active=False))
        # Ignore mistakes that exist without the new controller, such as an unloaded lower controller.
        known = self._mistakes(tuple(others.values()), rate)
        if found := [one for one in self._mistakes((*others.values(), plan), rate) if one not in known]:
            raise _refuse_entry(found)
        return plan

    def _compiled(self, plan: ControllerPlan) -> ControllerPlan:
        """Return a controller's plan with the interfaces that its class claims and reads; raises
        RefusedRequest.
        """
        model: type[ParametersModel] = ParametersModel
        try:
            # Unbounded, because this imports a package: an interrupted import would leave a partial module in
            # the process.
            offer = find_offer(plan.name, plan.type, self.plugins)
            model = offer.controller.Parameters
            with bounded(plan.name):
                wrapping = {joint.name for joint in self.joints.values() if joint.wrap}
                found = compile_entry(
                    plan,
                    offer,
                    tuple(self.joints),
                    wrapping=wrapping,
                    groups=self.groups,
                    omitted=self.omitted,
                )
                own = [self.joints[joint] for joint in found.plan.joints]
                require_fit(found, own, self.joints, self.urdf, self.poses.named)
            if found.registers:
                raise invalid(
                    f"{plan.name} changes registers, so it cannot be loaded; write it into the robot file"
                )
        except ValidationError as error:
            raise invalid(mistakes(error, plan.name, model)) from error
        except WrongEntry as wrong:
            raise _refuse_entry(wrong.mistakes) from wrong
        return found.plan

    def _mistakes(self, plans: Sequence[ControllerPlan], rate: float) -> list[Mistake]:
        """Return the mistakes of these controllers run together (claims, chains, rates) at this loop rate,
        Hz.
        """
        period_ns = round(1e9 / rate)
        now = [
            # The divider 0 marks a rate that does not divide the loop's rate; the loop refuses it.
            replace(plan, every=rate_divider(plan.rate, period_ns) if rate_fits(plan.rate, period_ns) else 0)
            for plan in plans
        ]
        return list(ControllerGraph(tuple(self.joints), now, self.sources).find_mistakes())


# Quantities with units


def _seconds(text: object) -> float:
    return duration(text) / 1e9


def _effort(value: object) -> object:
    if isinstance(value, str):
        raise ValueError(
            f"{value!r} is text; write a number in the model's unit of effort (Nm, A or a fraction of the "
            "maximum), such as 0.1 for 100 mA"
        )
    return value


def _fraction(value: object) -> object:
    if isinstance(value, str):
        raise ValueError(f"{value!r} is text; write a fraction of the full voltage, such as 0.2 for 20 %")
    return value


_OF_ALL_JOINTS: Mapping[str, Callable[[object], object]] = {
    "efforts": _effort,
    "pwm": _fraction,
    "time": _seconds,
    "start_in": _seconds,
}
_QUANTITIES: Mapping[JointUnit, Mapping[str, Callable[[object], object]]] = {
    ROTARY: {
        **_OF_ALL_JOINTS,
        "positions": angle,
        "velocities": angular_velocity,
        "accelerations": angular_acceleration,
    },
    LINEAR: {
        **_OF_ALL_JOINTS,
        "positions": length,
        "velocities": linear_velocity,
        "accelerations": linear_acceleration,
    },
}
"""Unit of a joint -> command field -> function that converts a quantity with its unit into SI."""


def joint_quantities(commands: Mapping[str, type[BaseModel]]) -> list[str]:
    """Return the interfaces for which a controller with these commands accepts values by joint."""
    given = {field for model in commands.values() for field in model.model_fields}
    given |= {"positions"} if TRAJECTORY in commands else set()
    return [name for name, field in GROUP_FIELDS.items() if field in given]


def _of_motions(kind: str, model: type[BaseModel]) -> bool:
    """Return whether quantities of a command may be texts with units: a trajectory, or a group's command."""
    fields = set(model.model_fields)
    return kind == TRAJECTORY or (bool(fields) and fields <= set(GROUP_FIELDS.values()))


def in_si(body: bytes, what: str, joints: Sequence[JointPlan] = ()) -> bytes:
    """Return a JSON command with its quantities converted from texts with units to numbers in SI units.

    Args:
        body: JSON of the command.
        what: Name of the command in a refusal.
        joints: Joints in the order of the values, unless the command names its joints. Values of linear
            joints become m, those of other joints rad.

    Raises:
        RefusedRequest: With all mistakes: sentences, and places as JSON Pointers (RFC 6901).
    """
    try:
        data = msgspec.json.decode(body)
    except RecursionError as error:
        raise invalid(BODY_TOO_DEEP) from error
    except msgspec.MsgspecError as error:
        raise invalid(f"{what} is not JSON: {error}") from error
    mistaken: dict[str, str] = {}
    plain = _plain(data, (), mistaken, _units_of(data, joints))
    if mistaken:
        raise _wrong_quantities(mistaken)
    return msgspec.json.encode(plain)


def _units_of(data: object, joints: Sequence[JointPlan]) -> tuple[JointUnit, ...]:
    """Return rad or m (the joint's unit) for each value in a command's lists; rad for an unknown joint."""
    units = {joint.name: joint.unit for joint in joints}
    named = data.get("joints") if isinstance(data, dict) else None
    names = named if isinstance(named, list) else [*units]
    return tuple(units.get(name, ROTARY) if isinstance(name, str) else ROTARY for name in names)


def plain_quantities(
    values: Mapping[str, object], field: str, joints: Sequence[JointPlan]
) -> dict[str, object]:
    """Return values by joint as numbers in SI units; texts have the units of the command field `field`.

    Raises RefusedRequest as `in_si`.
    """
    units = {joint.name: joint.unit for joint in joints}
    plain: dict[str, object] = {}
    mistaken: dict[str, str] = {}
    for joint, value in values.items():
        try:
            quantity = _QUANTITIES[units.get(joint, ROTARY)][field]
            plain[joint] = quantity(value)
        except ValueError as error:
            mistaken[f"/{joint}"] = f"{joint}: {error}"
    if mistaken:
        raise _wrong_quantities(mistaken)
    return plain


def _plain(
    value: object, path: tuple[str | int, ...], mistaken: dict[str, str], units: Sequence[JointUnit]
) -> object:
    if isinstance(value, dict):
        return {key: _plain(inner, (*path, key), mistaken, units) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner, (*path, index), mistaken, units) for index, inner in enumerate(value)]
    key = next((step for step in reversed(path) if isinstance(step, str)), "")
    place = path[-1] if path and isinstance(path[-1], int) else -1
    quantity = _QUANTITIES[units[place] if 0 <= place < len(units) else ROTARY].get(key)
    if quantity is None or value is None:
        return value
    try:
        return quantity(value)
    except ValueError as error:
        shown = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path)
        mistaken["".join(f"/{step}" for step in path)] = f"{shown.removeprefix('.')}: {error}"
        return None


def _wrong_quantities(mistaken: Mapping[str, str]) -> RefusedRequest:
    """Return the refusal of wrong quantities, whose sentences are given by JSON Pointer."""
    shown = dict([*mistaken.items()][:_MOST_QUANTITIES])
    problems, fixes = zip(*map(what_and_fix, shown.values()), strict=True)
    fields = {"paths": tuple(shown), "problems": problems, "fixes": fixes}
    return refused(Code.WRONG_QUANTITY, {"problem": "; ".join(shown.values()), **fields})


# Words


def mistakes(error: ValidationError, what: str, model: type[BaseModel]) -> str:
    """Return the first _MOST_MISTAKES mistakes of an input called `what` as one text, with the number of
    others.
    """
    sentences = [
        sentence[:_LONGEST_SENTENCE] for sentence in sentences_of(error, what, model, _MOST_MISTAKES)
    ]
    left = max(0, error.error_count() - _MOST_MISTAKES)
    return "; ".join(sentences) + (f"; and {left} more" if left else "")


def _refuse_entry(found: Sequence[Mistake]) -> RefusedRequest:
    """Return the refusal of a controller that a client wants to load, with the mistakes in its entry."""
    return invalid("; ".join(_one_line(f"{one.what}; {one.fix}") for one in found[:_MOST_MISTAKES]))


def unknown_controllers(
    names: Sequence[str], known: Sequence[str], plans: Sequence[ControllerPlan] = ()
) -> RefusedRequest:
    """Return the refusal for unknown controllers; hints are similar names, or those that move the joint."""
    shown = tuple(name[:80] for name in names[:_MOST_MISTAKES])
    moving = {name: [plan.name for plan in plans if plan.command and name in plan.joints] for name in shown}
    hints = [
        f"this is a joint; name a controller that moves it: {', '.join(moving[name])}"
        if moving[name]
        else suggestion(name, known)
        for name in shown
    ]
    if len(shown) > 1:
        hints = [f"{name}: {hint}" for name, hint in zip(shown, hints, strict=True)]
    return refused(Code.UNKNOWN_CONTROLLER, {"controller": shown, "hint": "; ".join(hints)})


def _one_line(text: str) -> str:
    return " ".join(text.split())
