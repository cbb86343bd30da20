"""Controller entry: checks a plug-in's entry of the robot file, a client's request or a replay.

Each mistake has its path in the robot file. The compiler converts the path into line and column; the gateway
and a replay use only the sentences.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TypeVar

import msgspec
from msgspec.structs import replace
from pydantic import ValidationError

from dxlrun.compile.controller_graph import Mistake
from dxlrun.contract.controller import RegisterChange
from dxlrun.control.controllers.offers import Breach
from dxlrun.control.controllers.plugin_loading import (
    Offer,
    PlugIns,
    interfaces_breach,
    mismatches,
    robot_model,
)
from dxlrun.control.controllers.single_files import is_of_file
from dxlrun.description.base_form import ParametersModel
from dxlrun.description.document import KeyPath
from dxlrun.description.mistakes.ros_types import ros_type
from dxlrun.description.robot import ControllerEntry
from dxlrun.errors import suggestion
from dxlrun.features.feature import SolvedPose
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan, RegisterPlan
from dxlwire.modes import CommandName

_OFFERED = (
    "install its package in this environment (`pip install PACKAGE`); "
    "`dxlrun plugins` lists the installed types"
)
_REMOVED = {
    "joint_limiter": "remove it: the gate keeps all goals within `limits` of their joints",
}
"""Controller types that dxlrun no longer has, each with the fix for the error message."""
Parameters = TypeVar("Parameters", bound=ParametersModel)


class WrongEntry(Exception):
    """Raised for an entry of a plug-in that cannot be used; `mistakes` holds everything that was wrong."""

    def __init__(self, *mistakes: Mistake) -> None:
        super().__init__("; ".join(f"{one.what}; {one.fix}" for one in mistakes))
        self.mistakes = mistakes


class CompiledController(msgspec.Struct, frozen=True):
    """A controller whose type was found and whose parameters are valid, with the plan for the run."""

    plan: ControllerPlan
    offer: Offer
    parameters: ParametersModel
    motors: tuple[str, ...] = ()  # figures of its joints' motors that it needs
    asked_by: Mapping[CommandName, KeyPath] = {}
    """Path of the parameter that made the controller claim a command interface; see `Interfaces.asked_by`."""
    registers: tuple[RegisterChange, ...] = ()  # registers that it may write during a run


class PlugInCode(msgspec.Struct, frozen=True):
    """Calls into a plug-in's class for one entry; converts any exception of its code into WrongEntry."""

    kind: str
    """Singular name of the section, `controller` or `sensor`, for messages."""
    name: str
    distribution: str

    def parameters(self, written: Mapping[str, object], model: type[Parameters]) -> Parameters:
        """Validate the keys of an entry and return them as an instance of the plug-in's parameters class.

        Raises:
            ValidationError: The parameters are invalid.
            WrongEntry: The plug-in's code raised another error.
        """
        try:
            return model.model_validate(written)
        except ValidationError:
            raise
        except (Exception, SystemExit) as error:
            raise self._failed("check its parameters", error) from error

    @contextmanager
    def asked_to(self, task: str) -> Iterator[None]:
        """Context manager around plug-in code: any exception becomes WrongEntry, `cannot TASK: ...`."""
        try:
            yield
        except (Exception, SystemExit) as error:
            raise self._failed(task, error) from error

    def broken(self, breach: Breach) -> WrongEntry:
        """Return the WrongEntry for a plug-in class that breaks its contract; its author must fix it."""
        what, fix = breach
        return self._at_fault(what, f"report this to the plug-in's author: {fix}")

    def _failed(self, task: str, error: BaseException) -> WrongEntry:
        found = " ".join(f"{type(error).__name__}: {error}".split())
        return self._at_fault(f"cannot {task}: {found}", "correct the parameters, or the plug-in")

    def _at_fault(self, what: str, fix: str) -> WrongEntry:
        path = (f"{self.kind}s", self.name)
        return WrongEntry(Mistake(path, f"{self.kind} {self.name} ({self.distribution}) {what}", fix))


def find_offer(name: str, type_name: str, plugins: PlugIns) -> Offer:
    """Return the installed controller class of a type and its package; raise WrongEntry if none is found."""
    offer = plugins.controllers.get(type_name)
    if offer is not None:
        return offer
    if ros := ros_type(type_name, plugins.controllers):
        what, fix, _ = ros
    elif is_of_file(type_name) and type_name in plugins.broken:
        what, fix = f"{type_name} of {name} cannot be used", plugins.broken[type_name]
    else:
        what = f"no plug-in offers the controller type {type_name} of {name}"
        fix = where_to_get(type_name, tuple(plugins.controllers), plugins.broken)
    raise WrongEntry(Mistake(("controllers", name, "type"), what, fix))


def where_to_get(type_name: str, known: Sequence[str], broken: Mapping[str, str]) -> str:
    """Return the fix for an unknown controller type: a similar name, a package, or a plug-in's problem.

    Args:
        type_name: The type.
        known: Available types.
        broken: Problems of plug-ins that cannot be used, by type or plug-in.
    """
    if type_name in broken:  # e.g. two plug-ins offer it
        return broken[type_name]
    if type_name in _REMOVED:
        return _REMOVED[type_name]
    named = [each for each in known if type_name in each.split("_")]  # `gripper`, `trajectory`
    close = suggestion(type_name, known, f"did you mean {' or '.join(named)}?" if named else _OFFERED)
    if not broken:
        return close
    why = "; ".join(broken.values())
    return f"{close} If not: {why}" if close.endswith("?") else why


def plan_entry(name: str, entry: ControllerEntry, every: int) -> ControllerPlan:
    """Return the plan of a controller from its keys in the file alone, before its class adds its claims."""
    return ControllerPlan(
        name=name,
        type=entry.type,
        distribution="",
        parameters=json.dumps(entry.parameters),  # as written, because the model accepts `60 deg`
        joints=(),
        command=(),
        publishes=(),
        active=entry.active,
        every=every,
        rate=entry.rate,
        fallback=entry.fallback or "",
        into=entry.into,
    )


def compile_entry(
    plan: ControllerPlan,
    offer: Offer,
    joints: Sequence[str],
    *,
    wrapping: Collection[str] = (),
    groups: Collection[str] = (),
    omitted: Sequence[str] = (),
) -> CompiledController:
    """Validate a controller's parameters and let its class fill in joints, claims, reads and topics.

    Args:
        plan: Plan of the entry, see `plan_entry`.
        offer: Offer of its type.
        joints: All joints of the robot.
        wrapping: Joints that take the shorter way round.
        groups: Names of groups, as suggestions for an unknown joint.
        omitted: Joints of the robot file that this run omits.

    Raises:
        ValidationError: Its parameters are invalid.
        WrongEntry: Its class fails, breaks the contract, or claims joints that it cannot have.
    """
    cls, code = offer.controller, PlugInCode("controller", plan.name, offer.distribution)
    written = json.loads(plan.parameters)
    parameters = code.parameters(written, cls.Parameters)
    if (found := wrapped(written, cls.Parameters, wrapping)) is not written:
        parameters = cls.Parameters.model_validate(found)
        plan = replace(plan, parameters=json.dumps(found))
    with code.asked_to("name its interfaces"):
        interfaces = cls.interfaces(parameters, tuple(joints))
        # With all joints of the file, a controller that reads every joint also reads those that are omitted.
        whole = cls.interfaces(parameters, (*joints, *omitted)) if omitted else interfaces
        reads = [name for name in whole.reads if name not in whole.optional] if omitted else []
    if breach := interfaces_breach(interfaces, chained=bool(plan.into)):
        raise code.broken(breach)
    needed = {*interfaces.joints, *(name.partition("/")[0] for name in reads)}
    mistakes = [_omitted_mistake(plan.name, joint) for joint in omitted if joint in needed]
    if mistakes := mistakes or [*_joint_mistakes(plan.name, interfaces.joints, joints, groups)]:
        raise WrongEntry(*mistakes)
    with code.asked_to("name its topics"):
        topics = tuple(cls.topics(parameters))
    plan = replace(
        plan,
        distribution=offer.distribution,
        joints=interfaces.joints,
        command=interfaces.command,
        publishes=cls.publishes,
        reference=interfaces.reference,
        reads=interfaces.reads,
        optional=interfaces.optional,
        provides=interfaces.provides,
        source_commands=interfaces.source_commands,
        takeovers=interfaces.takeovers,
        partial=interfaces.partial,
        registers=tuple(
            dict.fromkeys(RegisterPlan(one.joint, one.item, one.value) for one in interfaces.registers)
        ),
        topics=tuple(f"/{plan.name}/{topic}" for topic in topics),
    )
    return CompiledController(
        plan, offer, parameters, interfaces.motors, interfaces.asked_by, interfaces.registers
    )


def require_fit(
    controller: CompiledController,
    own: Sequence[JointPlan],
    joints: Iterable[str],
    urdf: str | None,
    poses: Mapping[str, SolvedPose],
) -> None:
    """Raise WrongEntry if a controller cannot work on the robot: motor data, servos or URDF do not fit.

    `own` are the controller's joints, `joints` the names of all, `urdf` is the text of the URDF, and `poses`
    are those with names.
    """
    plan, offer = controller.plan, controller.offer
    with PlugInCode("controller", plan.name, offer.distribution).asked_to("compare itself with the robot"):
        robot = robot_model(own, joints, urdf, poses)
        found = mismatches(offer.controller, controller.parameters, controller.motors, own, robot)
    if found:
        start = ("controllers", plan.name)
        raise WrongEntry(
            *(Mistake((*start, *one.at.split(".")), f"{plan.name} {one.what}", one.fix) for one in found)
        )


def wrapped(
    parameters: dict[str, object], model: type[ParametersModel], wrapping: Collection[str]
) -> dict[str, object]:
    """Add the key `wrap` with the joints that take the shorter way round, unless it is set or unsupported.

    `wrapping` are all such joints of the robot. A class that refuses `wrap` gets its parameters unchanged.
    """
    joints = parameters.get("joints")
    if "wrap" not in model.model_fields or "wrap" in parameters or not isinstance(joints, list | tuple):
        return parameters
    if not (own := [joint for joint in joints if joint in wrapping]):
        return parameters
    found = {**parameters, "wrap": own}
    try:
        model.model_validate(found)
    except Exception:  # a plug-in's code; the caller checks the parameters as written
        return parameters
    return found


def _omitted_mistake(name: str, joint: str) -> Mistake:
    what = f"{name} needs joint {joint}, which is omitted"
    return Mistake(("controllers", name, joint), what, f"remove {name}, or run with {joint}")


def _joint_mistakes(
    name: str, claimed: Sequence[str], joints: Sequence[str], groups: Collection[str]
) -> Iterator[Mistake]:
    for index, joint in enumerate(claimed):
        path = ("controllers", name, joint)
        if joint not in joints:
            fix = suggestion(joint, (*joints, *groups))
            yield Mistake(path, f"joint {joint} of {name} is not defined", fix)
        elif joint in claimed[:index]:
            yield Mistake(path, f"{name} names joint {joint} twice", "name it once")
