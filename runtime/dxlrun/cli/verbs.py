"""The verbs of the command line: those of the core, and those that installed packages add."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dxlrun.contract.hookspecs import Command

PLACES = {
    "examples": "dxlrun.cli.examples:examples",
    "check": "dxlrun.cli.check:check",
    "frames": "dxlrun.cli.frames:frames",
    "sim": "dxlrun.cli.sim.sim:sim",
    "schema": "dxlrun.cli.examples:schema",
    "models": "dxlrun.cli.tools.models:models",
    "plugins": "dxlrun.cli.plugins:plugins",
    "new-plugin": "dxlrun.cli.plugins:new_plugin",
    "scan": "dxlrun.cli.tools.scan:scan",
    "servo": "dxlrun.cli.tools.servo:servo",
    "doctor": "dxlrun.cli.doctor:doctor",
}
"""`module:function` of each verb of the core; it is imported when it is used."""
PLACES_WHILE_IT_RUNS = {
    verb: f"dxlrun.cli.steering.{place}"
    for verb, place in {
        "list": "steer:list_robots",
        "watch": "watch:watch",
        "get": "joints:get",
        "set": "joints:set_register",
        "torque": "joints:torque",
        "reboot": "joints:reboot",
        "switch": "steer:switch",
        "send": "goals:send",
        "play": "play:play",
        "cancel": "goals:cancel",
        "parameters": "parameters:parameters",
        "echo": "echo:echo",
        "rate": "steer:rate",
        "halt": "steer:halt",
        "pause": "steer:pause",
        "resume": "steer:resume",
        "load": "steer:load",
        "unload": "steer:unload",
        "stop": "steer:stop",
    }.items()
}
"""Verbs for a robot that runs, in the same way."""
_PACKAGES = {
    "dxlrun_analysis": ("analyze", "export", "logs"),
    "dxlrun_foxglove": ("foxglove",),
    "dxlrun_hand": ("setup", "calibrate", "teach"),
    "dxlrun_lab": (
        *("replay", "convert", "bench", "latency", "characterize", "experiment"),
        *("sweep", "identify"),
    ),
    "dxlrun_teleop": ("teleop",),
    "dxlrun_view": ("view",),
}
"""Verbs of this repository's packages, to name the package where it is not installed."""


def is_verb(word: str) -> bool:
    """Return whether a word may be a verb, and no path of a robot file."""
    return re.fullmatch(r"[a-z][a-z0-9-]*", word) is not None


@cache
def packaged() -> Mapping[str, Command]:
    """Return the verbs that installed packages add; a verb of the core stays the core's.

    A package that cannot be asked adds none: `dxlrun plugins` says why.
    """
    found: dict[str, Command] = {}
    for point in sorted(entry_points(group="dxlrun"), key=lambda each: each.name):
        with suppress(Exception, SystemExit):  # foreign code: what it does on import is its fault alone
            hook = getattr(point.load(), "dxlrun_commands", None)
            for command in hook() if hook is not None else ():
                found.setdefault(command.name, command)
    return {name: one for name, one in found.items() if name not in {**PLACES, **PLACES_WHILE_IT_RUNS}}


def is_importable(command: Command) -> bool:
    """Return whether the code of a verb is there; foreign code may be broken."""
    try:
        import_module(command.place.partition(":")[0])
    except (Exception, SystemExit):  # foreign code: what it does on import is its fault alone
        return False
    return True


def names() -> list[str]:
    """Return all verbs, those for a robot that runs last."""
    return sorted({*PLACES, *packaged()}) + list(PLACES_WHILE_IT_RUNS)


def package_of(verb: str) -> str:
    """Return which package of this repository has a verb; empty: none has."""
    return next((package for package, verbs in _PACKAGES.items() if verb in verbs), "")


def source_of(package: str) -> str:
    """Return the folder that pip installs a package of this repository from: with the core, or its own."""
    return "./plugins/dxlrun_view" if package == "dxlrun_view" else "."
