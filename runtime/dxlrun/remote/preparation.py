"""Preparation: what a client asks, checked against plan and plug-ins, and made ready for the loop.

All of a plug-in's code that a client can reach runs here, in the gateway's process, never in the loop's.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from pydantic import BaseModel, TypeAdapter, ValidationError

from dxlrun.compile.limits import beyond_limits
from dxlrun.control.controllers.contract import interfaces_breach
from dxlrun.control.controllers.controller import Interfaces
from dxlrun.control.controllers.plugins import Offer, PlugIns
from dxlrun.control.loop_plan import ControllerPlan, JointPlan
from dxlrun.description.form import Name
from dxlrun.description.robot import ControllerEntry
from dxlrun.description.source.problems import sentences_of
from dxlrun.errors import suggestion

LONGEST_NAME = 64
"""Of a controller that is loaded; the log cuts names there."""
BUDGET_S = 5.0
"""How long a plug-in may think about one wish, while every other client waits, who wants to stop too."""
_MOST_MISTAKES = 5
_LONGEST_SENTENCE = 300
_NAME: TypeAdapter[str] = TypeAdapter(Name)


class Refusal(Exception):
    """A client's wish that is not passed on; `status` is that of HTTP, the text a sentence for a person."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class _TooLong(BaseException):
    """A plug-in thought for too long; no Exception, which it may catch."""


@contextmanager
def _bounded(whose: str) -> Iterator[None]:
    """Interrupt a plug-in's Python code after BUDGET_S, in the main thread; raises Refusal then.

    A call into C that never returns is not interrupted: then Ctrl-C in the robot's terminal is what is left.
    """

    def interrupt(*_: object) -> None:
        raise _TooLong

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, BUDGET_S)
    try:
        yield
    except _TooLong:
        raise Refusal(
            422, f"{whose} thought about this for more than {BUDGET_S:g} s; send less at once"
        ) from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@dataclass(frozen=True, slots=True)
class Prepared:
    """A command, ready for the loop."""

    data: bytes
    """Little-endian float64"""
    beyond: tuple[str, ...]
    """A sentence for each value that is beyond its joint's limits."""

    def require_within_limits(self, what: str) -> None:
        """Raise Refusal when a value is beyond its joint's limits."""
        if self.beyond:
            left = len(self.beyond) - _MOST_MISTAKES
            more = f"; and {left} more" if left > 0 else ""
            raise Refusal(422, f"{what}: {'; '.join(self.beyond[:_MOST_MISTAKES])}{more}")


@dataclass(frozen=True, slots=True)
class Preparation:
    """Knows the controllers' classes; everything here happens outside of the loop's process."""

    joints: Mapping[str, JointPlan]
    """The robot's, by name, in its order."""
    plugins: PlugIns
    _takes: dict[str, dict[str, object]] = field(default_factory=dict, init=False)
    """Controller type -> schema of each command: nobody pays twice for it."""

    def offer(self, plan: ControllerPlan) -> Offer:
        """Return the class of a controller; raises Refusal."""
        offer = self.plugins.controllers.get(plan.type)
        if offer is None:
            raise Refusal(409, f"no plug-in offers the type {plan.type} of {plan.name} any more")
        return offer

    def takes(self, plan: ControllerPlan) -> dict[str, object]:
        """Return the JSON Schema of each command that a controller takes; empty where it cannot be had."""
        if plan.type not in self._takes:
            offer = self.plugins.controllers.get(plan.type)
            commands = offer.controller.Commands if offer else {}
            try:
                found: dict[str, object] = {k: model.model_json_schema() for k, model in commands.items()}
            except (Exception, SystemExit):  # a plug-in's code; its commands can be taken all the same
                found = {kind: {} for kind in commands}
            self._takes[plan.type] = found
        return self._takes[plan.type]

    def command(self, plan: ControllerPlan, kind: str, body: bytes) -> Prepared:
        """Return a typed command that came as JSON (`true` and "1" are no numbers there); raises Refusal."""
        controller = self.offer(plan).controller
        model = controller.Commands.get(kind)
        if model is None:
            known = tuple(controller.Commands)
            if not known:
                raise Refusal(404, f"{plan.name} takes no commands")
            raise Refusal(404, f"{plan.name} takes no command {kind}; {suggestion(kind, known)}")
        try:
            with _bounded(plan.name):
                command = model.model_validate_json(body, strict=True)
                parameters = controller.Parameters.model_validate_json(plan.parameters)
                prepared = controller.prepare(kind, command, parameters)
                data = np.ascontiguousarray(prepared, dtype="<f8").tobytes()
                beyond = beyond_limits([self.joints[joint] for joint in plan.joints], command)
                return Prepared(data, tuple(beyond))
        except Refusal:
            raise
        except ValidationError as error:
            raise Refusal(422, told(error, f"{kind} of {plan.name}", model)) from error
        except ValueError as error:  # the way in which a plug-in refuses
            raise Refusal(422, f"{kind} of {plan.name}: {_one_line(str(error))}") from error
        except (Exception, SystemExit) as error:  # a plug-in's mistake
            raise Refusal(422, f"{kind} of {plan.name}: {_raised(error)}") from error

    def controller(self, wish: Mapping[str, object], others: Collection[str]) -> ControllerPlan:
        """Return the plan of a controller that is to be loaded beside `others`; raises Refusal.

        `wish` is an entry of the robot file, with its name.
        """
        try:
            name = _NAME.validate_python(wish.get("name", ""))
            entry = ControllerEntry.model_validate({k: v for k, v in wish.items() if k != "name"})
        except ValidationError as error:
            raise Refusal(422, told(error, "the controller's entry", ControllerEntry)) from error
        if len(name) > LONGEST_NAME:
            raise Refusal(422, f"a name has at most {LONGEST_NAME} characters; choose a shorter one")
        if name in others:
            raise Refusal(409, f"there is a controller {name} already; choose another name, or unload it")
        if wish.get("active"):
            raise Refusal(422, f"{name} cannot be active at once; load it, then switch to it")
        if entry.fallback is not None and entry.fallback not in others:
            known = suggestion(entry.fallback, tuple(others))
            raise Refusal(422, f"there is no fallback {entry.fallback}; {known}")
        offer = self.plugins.controllers.get(entry.type)
        if offer is None:
            known = suggestion(entry.type, tuple(self.plugins.controllers))
            raise Refusal(422, f"no plug-in offers the controller type {entry.type}; {known}")
        interfaces = self._interfaces(name, offer, entry.parameters)
        return ControllerPlan(
            name=name,
            type=entry.type,
            distribution=offer.distribution,
            parameters=json.dumps(entry.parameters),
            joints=interfaces.joints,
            command=interfaces.command,
            publishes=offer.controller.publishes,
            active=False,
            every=1,  # the loop knows its own rate
            rate=entry.rate,
            fallback=entry.fallback or "",
        )

    def _interfaces(self, name: str, offer: Offer, own: Mapping[str, object]) -> Interfaces:
        """Ask a controller's class what it wants with these parameters."""
        try:
            with _bounded(name):
                parameters = offer.controller.Parameters.model_validate(own)
                interfaces = offer.controller.interfaces(parameters, tuple(self.joints))
        except Refusal:
            raise
        except ValidationError as error:
            raise Refusal(422, told(error, name, offer.controller.Parameters)) from error
        except (Exception, SystemExit) as error:  # a plug-in's code
            raise Refusal(422, f"{name} cannot say what it needs: {_raised(error)}") from error
        if breach := interfaces_breach(interfaces):
            raise Refusal(422, f"{name} ({offer.distribution}) {breach[0]}; tell its author: {breach[1]}")
        if unknown := [joint for joint in interfaces.joints if joint not in self.joints]:
            raise Refusal(
                422, f"{name} wants joint {unknown[0]}; {suggestion(unknown[0], tuple(self.joints))}"
            )
        if len(set(interfaces.joints)) != len(interfaces.joints):
            raise Refusal(422, f"{name} names a joint twice; name it once")
        return interfaces


def told(error: ValidationError, what: str, model: type[BaseModel]) -> str:
    """Return the mistakes of an input called `what` in one sentence; of many, the first."""
    mistakes = sentences_of(error, what, model, _MOST_MISTAKES)
    sentences = [sentence[:_LONGEST_SENTENCE] for sentence in mistakes]
    left = max(0, error.error_count() - _MOST_MISTAKES)
    return "; ".join(sentences) + (f"; and {left} more" if left else "")


def _raised(error: BaseException) -> str:
    return _one_line(f"{type(error).__name__}: {error}")


def _one_line(text: str) -> str:
    return " ".join(text.split())
