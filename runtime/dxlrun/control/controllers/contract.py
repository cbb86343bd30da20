"""What a plug-in must be: its hooks against `hookspecs`, its controllers against `Controller`.

Each check returns what is wrong and how to mend it, or None. Foreign code is judged when it is loaded, so
that its author reads one sentence, and nobody a traceback out of the middle of a run.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import pluggy

from dxlrun.control.controllers.controller import CommandModel, Controller, Interfaces, ParametersModel
from dxlrun.control.controllers.hookspecs import HookSpecs
from dxlrun.description.modes import COMMAND_INTERFACES, mode_of

ControllerClass = type[Controller[Any]]
Breach = tuple[str, str]
"""What is wrong, and how to mend it."""

_METHODS = (
    "__init__",
    "interfaces",
    "prepare",
    "on_configure",
    "on_activate",
    "on_command",
    "update",
    "on_deactivate",
)
"""Called by dxlrun, all by position."""
_HOOKS = tuple(name for name in vars(HookSpecs) if name.startswith("dxlrun_"))


def hook_breach(plugin: object, manager: pluggy.PluginManager) -> Breach | None:
    """Judge the hooks that a module implements: their names, their marks, their arguments."""
    for name in dir(plugin):
        hook = getattr(plugin, name, None)
        marked = manager.parse_hookimpl_opts(plugin, name) is not None
        if not marked:
            if name in _HOOKS and callable(hook):
                return f"has a function {name} that is not marked as a hook", "put @dxlrun.hookimpl above it"
            continue
        if name not in _HOOKS:
            return f"implements a hook {name} that dxlrun does not have", f"hooks are {', '.join(_HOOKS)}"
        wanted = [*inspect.signature(getattr(HookSpecs, name)).parameters][1:]
        found = [*inspect.signature(hook).parameters] if callable(hook) else []
        if not set(found) <= set(wanted):
            return (
                f"implements {name}({', '.join(found)}), but the hook is {name}({', '.join(wanted)})",
                "take the other arguments out",
            )
    return None


def controller_breach(controller: object) -> Breach | None:
    """Judge a class that is offered as a controller."""
    if not (isinstance(controller, type) and issubclass(controller, Controller)):
        return "which is no controller", "derive a class from dxlrun.Controller"
    missing = sorted(getattr(controller, "__abstractmethods__", ()))
    if missing:
        return f"which has no method {' and no method '.join(missing)}", "write it"
    for name in _METHODS:
        if not _takes(getattr(controller, name), getattr(Controller, name)):
            return (
                f"whose {name}{_arguments(getattr(controller, name))} cannot be called as "
                f"{name}{_arguments(getattr(Controller, name))}",
                "give it these arguments",
            )
    return _declaration_breach(controller)


def interfaces_breach(interfaces: object) -> Breach | None:
    """Judge what a controller's `interfaces` returned."""
    if not isinstance(interfaces, Interfaces):
        return f"returns {interfaces!r} from interfaces", "return dxlrun.Interfaces(joints, command)"
    for what, names in (("joints", interfaces.joints), ("command", interfaces.command)):
        if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names):
            return f"asks for {what} {names!r}", f"{what} of dxlrun.Interfaces is a tuple of names"
    unknown = [name for name in interfaces.command if name not in COMMAND_INTERFACES]
    if unknown:
        return (
            f"asks for the command interface {', '.join(unknown)}",
            f"command interfaces are {', '.join(COMMAND_INTERFACES)}",
        )
    try:
        mode_of(interfaces.command or ("position",))
    except ValueError as error:
        return (
            f"asks for command interfaces that do not go together: {error}",
            "ask for position (with velocity or effort beside it), or for velocity, effort or pwm alone",
        )
    return None


def _declaration_breach(controller: ControllerClass) -> Breach | None:
    if not _is_model(controller.Parameters, ParametersModel):
        return "whose Parameters is no model of parameters", "derive it from dxlrun.ParametersModel"
    commands: object = controller.Commands
    if not isinstance(commands, Mapping) or not all(
        isinstance(kind, str) and _is_model(model, CommandModel) for kind, model in commands.items()
    ):
        return "whose Commands is no mapping of names to models", "write {name: class of dxlrun.CommandModel}"
    publishes: object = controller.publishes
    if not isinstance(publishes, tuple) or not all(isinstance(topic, str) for topic in publishes):
        return "whose publishes is no tuple of topics", 'write publishes = ("/joint_states",)'
    return None


def _is_model(found: object, base: type) -> bool:
    return isinstance(found, type) and issubclass(found, base)


def _takes(found: Callable[..., object], wanted: Callable[..., object]) -> bool:
    """Return whether a method can be called as the contract's: by position, with as many arguments."""
    if found is wanted:  # inherited
        return True
    count = len(inspect.signature(wanted).parameters)
    try:
        inspect.signature(found).bind(*range(count))
    except (TypeError, ValueError):  # ValueError: nothing is known about its arguments
        return False
    return True


def _arguments(method: Callable[..., object]) -> str:
    return f"({', '.join(str(name) for name in inspect.signature(method).parameters if name != 'self')})"
