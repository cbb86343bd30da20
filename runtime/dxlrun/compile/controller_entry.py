"""Entry of a plug-in's class, such as a controller: its checks, for a robot file, a client and a replay.

Each mistake has the path in the robot file that it is about. The compiler shows where that path is, the
gateway and a replay refuse with the sentences.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple, TypeVar

import msgspec
from msgspec.structs import replace
from pydantic import ValidationError

from dxlrun.compile.graph import Mistake
from dxlrun.control.controllers.offers import Breach
from dxlrun.control.controllers.plugins import Offer, PlugIns, interfaces_breach, mismatches
from dxlrun.control.controllers.single_files import is_of_file
from dxlrun.description.document import KeyPath
from dxlrun.description.form import ParametersModel
from dxlrun.description.mistakes.foreign import ros_type
from dxlrun.description.robot import ControllerEntry
from dxlrun.errors import suggestion
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan
from dxlwire.modes import CommandName

_OFFERED = (
    "install the package that offers it into this environment (`pip install PACKAGE`); "
    "`dxlrun plugins` lists the types that there are"
)
_REMOVED = {
    "joint_limiter": "take it out: the gate keeps all goals within `limits` of their joints",
}
"""Types of earlier versions, and what to do instead."""
Parameters = TypeVar("Parameters", bound=ParametersModel)


class WrongEntry(Exception):
    """An entry that cannot be used, with all mistakes that a check found."""

    def __init__(self, *mistakes: Mistake) -> None:
        super().__init__("; ".join(f"{one.what}; {one.fix}" for one in mistakes))
        self.mistakes = mistakes


class CompiledController(msgspec.Struct, frozen=True):
    """A controller whose type is known and whose parameters are valid."""

    plan: ControllerPlan
    offer: Offer
    parameters: ParametersModel
    motors: tuple[str, ...] = ()  # Figures of its joints' motors that it needs
    asked_by: Mapping[CommandName, KeyPath] = {}
    """The key of its parameters for which it claims a command interface, see `Interfaces`."""


class PlugInCode(NamedTuple):
    """The class of an entry, whose code may raise anything."""

    kind: str
    """Word in messages, with which the section is named: `sensor`."""
    name: str
    distribution: str

    def parameters(self, written: Mapping[str, object], model: type[Parameters]) -> Parameters:
        """Return the parameters of an entry. Raises ValidationError, and WrongEntry for other errors."""
        try:
            return model.model_validate(written)
        except ValidationError:
            raise
        except (Exception, SystemExit) as error:
            raise self._failed("check its parameters", error) from error

    @contextmanager
    def asked_to(self, task: str) -> Iterator[None]:
        """Run code of the plug-in. Raises WrongEntry for whatever it raises."""
        try:
            yield
        except (Exception, SystemExit) as error:
            raise self._failed(task, error) from error

    def broken(self, breach: Breach) -> WrongEntry:
        """Return the error for a class that does not keep the contract."""
        what, fix = breach
        return self._at_fault(what, f"report it to its author: {fix}")

    def _failed(self, task: str, error: BaseException) -> WrongEntry:
        found = " ".join(f"{type(error).__name__}: {error}".split())
        return self._at_fault(f"cannot {task}: {found}", "correct its parameters, or its plug-in")

    def _at_fault(self, what: str, fix: str) -> WrongEntry:
        path = (f"{self.kind}s", self.name)
        return WrongEntry(Mistake(path, f"{self.kind} {self.name} ({self.distribution}) {what}", fix))


def find_offer(name: str, type_name: str, plugins: PlugIns) -> Offer:
    """Return the offer of a controller's type. Raises WrongEntry where there is none."""
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
    """Return how to get a type of plug-ins: another spelling, another package, or the repair of a broken one.

    `known` are the types that there are, `broken` the plug-ins that cannot be used.
    """
    if type_name in broken:  # two plug-ins offer it
        return broken[type_name]
    if type_name in _REMOVED:
        return _REMOVED[type_name]
    close = suggestion(type_name, known, _OFFERED)
    if not broken:
        return close
    why = "; ".join(broken.values())
    return f"{close} If not: {why}" if close.endswith("?") else why


def plan_entry(name: str, entry: ControllerEntry, every: int) -> ControllerPlan:
    """Return the plan of a controller with what its entry says, without what its class asks for."""
    return ControllerPlan(
        name=name,
        type=entry.type,
        distribution="",
        parameters=json.dumps(entry.parameters),  # as written: `60 deg` is what the model accepts
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
) -> CompiledController:
    """Return a controller with what its class asks for.

    Args:
        plan: What the entry says, see `plan_entry`.
        offer: Offer of its type.
        joints: All joints of the robot.
        wrapping: Those that go the shorter way round.
        groups: Names of groups, which are proposed for an unknown joint.

    Raises:
        ValidationError: Its parameters are wrong.
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
    if breach := interfaces_breach(interfaces, chained=bool(plan.into)):
        raise code.broken(breach)
    if mistakes := tuple(_joint_mistakes(plan.name, interfaces.joints, joints, groups)):
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
        provides=interfaces.provides,
        source_commands=interfaces.source_commands,
        takeovers=interfaces.takeovers,
        partial=interfaces.partial,
        topics=tuple(f"/{plan.name}/{topic}" for topic in topics),
    )
    return CompiledController(plan, offer, parameters, interfaces.motors, interfaces.asked_by)


def require_fit(controller: CompiledController, joints: Sequence[JointPlan], urdf: str | None) -> None:
    """Raise WrongEntry where the robot does not fit a controller: motors, servos, the URDF.

    `joints` are its own.
    """
    plan, offer = controller.plan, controller.offer
    with PlugInCode("controller", plan.name, offer.distribution).asked_to("compare itself with the robot"):
        found = mismatches(offer.controller, controller.parameters, controller.motors, joints, urdf)
    if found:
        start = ("controllers", plan.name)
        raise WrongEntry(
            *(Mistake((*start, *one.at.split(".")), f"{plan.name} {one.what}", one.fix) for one in found)
        )


def wrapped(
    parameters: dict[str, object], model: type[ParametersModel], wrapping: Collection[str]
) -> dict[str, object]:
    """Return the parameters of a controller with `wrap`, where they leave it out and some joints wrap.

    A controller that cannot wrap them, such as one of velocities, keeps its own.
    """
    joints = parameters.get("joints")
    if "wrap" not in model.model_fields or "wrap" in parameters or not isinstance(joints, list | tuple):
        return parameters
    if not (own := [joint for joint in joints if joint in wrapping]):
        return parameters
    found = {**parameters, "wrap": own}
    try:
        model.model_validate(found)
    except Exception:  # a plug-in's code; the parameters as written are checked by themselves
        return parameters
    return found


def _joint_mistakes(
    name: str, claimed: Sequence[str], joints: Sequence[str], groups: Collection[str]
) -> Iterator[Mistake]:
    for index, joint in enumerate(claimed):
        path = ("controllers", name, joint)
        if joint not in joints:
            fix = suggestion(joint, (*joints, *groups))
            yield Mistake(path, f"{name} claims joint {joint}, which is not defined", fix)
        elif joint in claimed[:index]:
            yield Mistake(path, f"{name} names joint {joint} twice", "name it once")
