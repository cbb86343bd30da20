"""Preparation: what a client asks, checked against plan and plug-ins, and made ready for the loop."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

from pydantic import ValidationError

from dxlrun.compile.problems import suggestion
from dxlrun.control.contract import interfaces_breach
from dxlrun.control.loop_plan import ControllerPlan
from dxlrun.control.plugins import Offer, PlugIns

_OWN_KEYS = ("name", "type", "rate", "fallback")


class Refusal(Exception):
    """A client's wish that is not passed on; `status` is that of HTTP, the text a sentence for a person."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


@dataclass(frozen=True, slots=True)
class Preparation:
    """Knows the controllers' classes; everything here happens outside of the loop's process."""

    joints: tuple[str, ...]
    plugins: PlugIns

    def offer(self, plan: ControllerPlan) -> Offer:
        """Return the class of a controller; raises Refusal."""
        offer = self.plugins.controllers.get(plan.type)
        if offer is None:
            raise Refusal(409, f"no plug-in offers the type {plan.type} of {plan.name} any more")
        return offer

    def takes(self, plan: ControllerPlan) -> dict[str, object]:
        """Return the JSON Schema of each command that a controller takes."""
        commands = self.offer(plan).controller.Commands
        return {kind: model.model_json_schema() for kind, model in commands.items()}

    def command(self, plan: ControllerPlan, kind: str, body: bytes) -> bytes:
        """Return the array of a typed command that came as JSON; raises Refusal."""
        controller = self.offer(plan).controller
        model = controller.Commands.get(kind)
        if model is None:
            known = tuple(controller.Commands)
            if not known:
                raise Refusal(404, f"{plan.name} takes no commands")
            raise Refusal(404, f"{plan.name} takes no command {kind}; {suggestion(kind, known)}")
        try:
            command = model.model_validate_json(body)
            parameters = controller.Parameters.model_validate_json(plan.parameters)
            return controller.prepare(kind, command, parameters).astype("<f8").tobytes()
        except ValidationError as error:
            raise Refusal(422, f"{kind} of {plan.name}: {told(error)}") from error
        except (
            Exception
        ) as error:  # a plug-in's code: ValueError is its way to refuse, others are its mistakes
            what = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            raise Refusal(422, f"{kind} of {plan.name}: {' '.join(what.split())}") from error

    def controller(self, entry: Mapping[str, object]) -> ControllerPlan:
        """Return the plan of a controller that is to be loaded; `entry` is as in the robot file."""
        name, type_name = str(entry.get("name", "")), str(entry.get("type", ""))
        offer = self.plugins.controllers.get(type_name)
        if not name.isidentifier() or offer is None:
            known = suggestion(type_name, tuple(self.plugins.controllers))
            raise Refusal(422, f"a controller needs a name and a type that a plug-in offers; {known}")
        rate, fallback = entry.get("rate"), entry.get("fallback", "")
        if not (rate is None or (isinstance(rate, int | float) and rate > 0)):
            raise Refusal(422, f"rate {rate!r} of {name} is no number of Hz")
        own = {key: value for key, value in entry.items() if key not in _OWN_KEYS}
        try:
            parameters = offer.controller.Parameters.model_validate(own)
            interfaces = offer.controller.interfaces(parameters, self.joints)
        except ValidationError as error:
            raise Refusal(422, f"{name}: {told(error)}") from error
        except Exception as error:  # a plug-in's code
            raise Refusal(422, f"{name} cannot say what it needs: {type(error).__name__}: {error}") from error
        if breach := interfaces_breach(interfaces):
            raise Refusal(422, f"{name} ({offer.distribution}) {breach[0]}; tell its author: {breach[1]}")
        if unknown := [joint for joint in interfaces.joints if joint not in self.joints]:
            raise Refusal(422, f"{name} wants joint {unknown[0]}; {suggestion(unknown[0], self.joints)}")
        return ControllerPlan(
            name=name,
            type=type_name,
            distribution=offer.distribution,
            parameters=json.dumps(own),
            joints=interfaces.joints,
            command=interfaces.command,
            publishes=offer.controller.publishes,
            active=False,
            every=1,
            rate=None if rate is None else float(rate),
            fallback=str(fallback),
        )


def told(error: ValidationError) -> str:
    """Return the mistakes of an input in one sentence."""
    return "; ".join(
        f"{'.'.join(str(part) for part in one['loc']) or 'the whole'}: {one['msg']}"
        for one in error.errors(include_url=False, include_context=False)
    )
