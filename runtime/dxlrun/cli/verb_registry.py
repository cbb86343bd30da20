"""Verbs: the names of all commands (verbs), from the core and from installed packages."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from dxlrun.errors import InputError
from dxlrun.installed_plugins import InstalledPlugin, installed_plugins

if TYPE_CHECKING:
    from dxlrun.contract.hookspecs import Command

EXAMPLES = Path(__file__).with_name("examples.txt")
"""File with example command lines, one a line; a test parses them."""

EVERY_DAY = "Every day"
_CLI, _STEERING, _TOOLS = "dxlrun.cli", "dxlrun.cli.steering", "dxlrun.cli.tools"
GROUPS: Mapping[str, Mapping[str, str]] = {
    # In the sequence of their use.
    EVERY_DAY: {
        "help": f"{_CLI}.verb_help:show_help",
        "demo": f"{_CLI}.run:demo",
        "examples": f"{_CLI}.examples:examples",
        "doctor": f"{_CLI}.doctor:doctor",
        "scan": f"{_TOOLS}.scan:scan",
        "check": f"{_CLI}.check:check_robot",
        "list": f"{_STEERING}.steer:list_robots",
        "watch": f"{_STEERING}.watch:watch_robot",
        "play": f"{_STEERING}.play:play_motions",
        "stop": f"{_STEERING}.steer:stop",
    },
    "Robots that run": {
        "get": f"{_STEERING}.joints:show_joint",
        "set": f"{_STEERING}.joints:set_register",
        "torque": f"{_STEERING}.joints:torque",
        "reboot": f"{_STEERING}.joints:reboot",
        "switch": f"{_STEERING}.steer:switch",
        "send": f"{_STEERING}.goals:send",
        "cancel": f"{_STEERING}.goals:cancel",
        "parameters": f"{_STEERING}.parameters:parameters",
        "echo": f"{_STEERING}.echo:echo",
        "rate": f"{_STEERING}.steer:rate",
        "halt": f"{_STEERING}.steer:halt",
        "pause": f"{_STEERING}.steer:pause",
        "resume": f"{_STEERING}.steer:resume_robot",
        "take-over": f"{_STEERING}.steer:take_over",
        "load": f"{_STEERING}.steer:load_controller",
        "unload": f"{_STEERING}.steer:unload_controller",
    },
    "Robot files": {"frames": f"{_CLI}.frames:frames", "models": f"{_TOOLS}.models:models"},
    "Servos": {"servo": f"{_TOOLS}.servo:servo", "sim": f"{_CLI}.sim.sim:sim"},
    "Logs": {},
    "Experiments": {},
    "Developing": {
        "schema": f"{_CLI}.examples:schema",
        "plugins": f"{_CLI}.plugins:plugins",
        "new-plugin": f"{_CLI}.plugins:new_plugin",
    },
}
"""Headings of the help in their order, with `module:function` of each verb of the core, imported on use.
Verbs of packages name their heading, see `Command.group`."""
_PACKAGES = {
    "dxlrun_analysis": ("analyze", "export", "logs", "upload"),
    "dxlrun_fleet": ("fleet", "keys"),
    "dxlrun_foxglove": ("foxglove",),
    "dxlrun_hand": ("setup", "calibrate", "teach"),
    "dxlrun_import": ("import",),
    "dxlrun_lab": ("replay", "convert", "bench", "latency", "characterize", "experiment", "identify"),
    "dxlrun_space": ("reach",),
    "dxlrun_teleop": ("teleop",),
    "dxlrun_view": ("view",),
}
"""Package of this repository -> its verbs, to name the package when it is not installed."""


_OTHER_WORDS = {
    "": "run start launch",
    "check": "validate lint",
    "list": "ls ps status",
    "stop": "kill",
    "sim": "simulate",
    "scan": "ping discover",
    "analyze": "report plot",
    "watch": "monitor top",
    "send": "move",
    "torque on": "enable",
    "torque off": "disable relax",
    "set": "write",
    "get": "read",
    "examples": "init new",
    "teach": "record",
    "--version": "version",
}
"""Verb -> words that other programs use for it; the empty verb is `dxlrun ROBOT.yaml`."""


def verb_for(word: str) -> str | None:
    """Return the verb (with its first argument, if needed) for a word of another program; None if unknown."""
    return next((verb for verb, words in _OTHER_WORDS.items() if word in words.split()), None)


RENAMED: Mapping[str, Mapping[str, str]] = {
    "foxglove": {"--port": "--listen :PORT"},
    "frames": {"--in": "--relative-to"},
    "keys": {"--to": "--output"},
    "servo": {"--keep": "--except"},
    "teach": {"--speed": "--velocity"},
    "view": {"--port": "--listen :PORT"},
}
"""Verb -> old name of an option -> its new name."""


def is_verb(word: str) -> bool:
    """Return True when a word has the form of a verb and is not a path; the verb may be unknown."""
    return re.fullmatch(r"[a-z][a-z0-9-]*", word) is not None


def packaged() -> Mapping[str, Command]:
    """Return the commands of installed packages by verb, without verbs that the core has.

    A package that fails adds none: `dxlrun plugins` reports the reason.
    """
    return _packaged(installed_plugins())


@cache
def _packaged(plugins: tuple[InstalledPlugin, ...]) -> Mapping[str, Command]:
    found: dict[str, Command] = {}
    for plugin in plugins:
        # Foreign code may raise any exception on import.
        with suppress(Exception, SystemExit):
            hook = getattr(plugin.point.load(), "dxlrun_commands", None)
            for command in hook() if hook is not None else ():
                found.setdefault(command.name, command)
    return {name: one for name, one in found.items() if not any(name in verbs for verbs in GROUPS.values())}


def is_importable(command: Command) -> bool:
    """Return True when the module of a package's command can be imported; foreign code may be broken."""
    try:
        import_module(command.place.partition(":")[0])
    # Foreign code may raise any exception on import.
    except (Exception, SystemExit):
        return False
    return True


def names() -> list[str]:
    """Return the verbs of core and installed packages in alphabetical order."""
    return sorted({*chain(*GROUPS.values()), *packaged()})


def examples_of(verb: Sequence[str]) -> list[str]:
    """Return the example command lines of a command, or of a run; empty without one."""
    words = ["dxlrun", *verb]
    lines = [line for line in EXAMPLES.read_text().splitlines() if line.split()[: len(words)] == words]
    return lines if verb else [line for line in lines if line.split()[1].endswith(".yaml")]


def require_package(verb: str) -> None:
    """Raise InputError when a verb belongs to a package of this repository that is absent or broken."""
    if (package := package_of(verb)) and verb not in packaged():
        problem = "which is not installed" if find_spec(package) is None else "whose import failed"
        raise InputError(
            f"`dxlrun {verb}` needs the package {package}, {problem}; "
            f"run `pip install {source_of(package)}` in a clone of dxlrun"
        )


def package_of(verb: str) -> str:
    """Return the name of this repository's package that has a verb; empty for other verbs."""
    return next((package for package, verbs in _PACKAGES.items() if verb in verbs), "")


def source_of(package: str) -> str:
    """Return the folder of the repository from which pip installs one of its packages."""
    return "./plugins/dxlrun_view" if package == "dxlrun_view" else "."
