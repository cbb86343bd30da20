"""Parameters: list a controller's parameters in a run, and validate changes of the live ones."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from msgspec.structs import replace
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from dxlrun.channels.answers import Code, Field
from dxlrun.channels.loop_requests import ParametersRequest
from dxlrun.control.controllers.live_parameters import live_names, value_of
from dxlrun.description.base_form import ParametersModel
from dxlrun.errors import suggestion
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun.remote.preparation import invalid, mistakes, plugin_code, refused
from dxlrun.remote.requests.replies import NewValue, Parameter, Written

_BOUNDS = (("ge", "at least"), ("gt", "above"), ("le", "at most"), ("lt", "below"))


@dataclass(frozen=True, slots=True)
class PreparedChange:
    """A validated change of a controller's live parameters."""

    request: ParametersRequest
    plan: ControllerPlan
    """The controller's plan with the new values, for the gateway after the loop has changed them."""
    shown: tuple[NewValue, ...]


def parameters_of(model: BaseModel, prefix: str = "") -> Iterator[Parameter]:
    """Yield all parameters of a controller with range and description; nested ones have dotted names."""
    live = frozenset(live_names(model))
    values = model.model_dump(mode="json")
    for name, field in type(model).model_fields.items():
        value, range_, about = getattr(model, name), _range(field), field.description or ""
        if isinstance(value, BaseModel):
            yield from parameters_of(value, f"{prefix}{name}.")
        elif isinstance(value, Mapping) and any(one.startswith(f"{name}.") for one in live):
            for key, inner in values[name].items():
                yield Parameter(f"{prefix}{name}.{key}", inner, True, range_, about)
        else:
            yield Parameter(f"{prefix}{name}", values[name], name in live, range_, about)


def _range(field: FieldInfo) -> str:
    bounds = (
        (words, getattr(mark, key)) for mark in field.metadata for key, words in _BOUNDS if hasattr(mark, key)
    )
    return ", ".join(f"{words} {value:g}" for words, value in bounds if isinstance(value, int | float))


def changed(plan: ControllerPlan, now: ParametersModel, values: Mapping[str, Written]) -> PreparedChange:
    """Return the validated change of live parameters that now have the values `now`.

    Raises RefusedRequest for an unknown or fixed parameter, or an invalid value.
    """
    if not values:
        raise invalid('nothing to change; write for example {"values": {"speed": "20 deg/s"}}')
    known = {parameter.name: parameter for parameter in parameters_of(now)}
    for name in values:
        _require_live(plan.name, name[:80], known)
    model = type(now)
    written = json.loads(plan.parameters)
    for name, value in values.items():
        _put(written, name.split("."), value, now)
    with plugin_code(plan.name, f"the parameters of {plan.name}"):
        try:
            new = model.model_validate(written)
        except ValidationError as error:
            problem = mistakes(error, plan.name, model)
            wrong = {".".join(map(str, details["loc"])) for details in error.errors(include_url=False)}
            ranges = [
                f"{name}: {known[name].range}" for name in values if name in wrong and known[name].range
            ]
            raise invalid(problem + (f" ({'; '.join(ranges)})" if ranges else "")) from error
    before = {parameter.name: parameter.value for parameter in known.values()}
    after = {parameter.name: parameter.value for parameter in parameters_of(new)}
    # A parameter that a validator derives from another one changes with it.
    differing = [name for name in live_names(new) if name in values or before[name] != after[name]]
    return PreparedChange(
        ParametersRequest(plan.name, {name: _number(name, value_of(new, name)) for name in differing}),
        replace(plan, parameters=json.dumps(written)),
        tuple(NewValue(name, before[name], after[name]) for name in differing),
    )


def _require_live(controller: str, name: str, known: Mapping[str, Parameter]) -> None:
    fields: dict[str, Field] = {"controller": controller, "parameter": name}
    if name not in known:
        inner = [one for one in known if one.startswith(f"{name}.")]
        hint = f"name one of its values: {', '.join(inner)}" if inner else suggestion(name, tuple(known))
        raise refused(Code.UNKNOWN_PARAMETER, fields | {"hint": hint})
    if not known[name].live:
        live = ", ".join(one.name for one in known.values() if one.live)
        said = f"live are {live}" if live else "it has no live parameters"
        raise refused(Code.NOT_LIVE, fields | {"known": said})


def _put(written: dict[str, object], path: list[str], value: Written, now: object) -> None:
    """Set a value by path in parameters as written in the robot file; a short form on the path is written
    out.
    """
    for key in path[:-1]:
        now = now[key] if isinstance(now, Mapping) else getattr(now, key)
        inner = written.get(key)
        if not isinstance(inner, dict):
            inner = now.model_dump(mode="json") if key in written and isinstance(now, BaseModel) else {}
            written[key] = inner
        written = inner
    written[path[-1]] = value


def _number(name: str, value: object) -> bool | int | float:
    # A plug-in can mark a parameter of any type as live.
    if not isinstance(value, bool | int | float):
        raise invalid(f"{name} = {value!r} cannot change in a run; only numbers and bools can")
    return value
