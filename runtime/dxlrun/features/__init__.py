"""Features: one folder or module for each section or key of the robot file, from its form to its run code.

It contains one feature for every stage, from its form to its part in the loop. Code that two features share
belongs to the package of that stage. `feature.py` describes the files; `FEATURES` lists the features.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from typing import Any, cast

from msgspec.structs import replace

from dxlrun.features.feature import Feature, JointKey, PolicyKey, PoseStage, S, Section, ServoKey, type_of
from dxlrun.installed_plugins import InstalledPlugin, installed_plugins

FEATURES = (
    Feature("devices", "dxlrun.features.devices"),
    Feature("on_lost_servo", "dxlrun.features.lost_servos"),
    Feature("on_stale_command", "dxlrun.features.stale_commands"),
    Feature("sensors", "dxlrun.features.sensors"),
    Feature("transmissions", "dxlrun.features.mechanics"),
    Feature("registers", "dxlrun.features.registers"),
    Feature("homing_offset", "dxlrun.features.homing_offset"),
    Feature("recording", "dxlrun.features.recording"),
)
"""Built-in features, in the order in which every stage calls them and in which their states are recorded."""

_JOINTS = (
    "bus continuous direction gear_ratio id installed joints limits model motor ratio reference servos "
    "simulation tolerance torque travel_per_turn unit wrap "
    "acceleration bounded effort effort_source effort_unit linear lower mode name position_source "
    "reach_lower reach_upper upper velocity velocity_source"
)
_SECTIONS = "arguments include joint_defaults loop model name poses processes read_before simulation"
_REPORT = "robot rate joints groups omitted poses controllers buses policies motions graph duration online"
"""Keys of the report of `dxlrun check`; a feature cannot have one as its name, because its rows are added
there under its name."""
RESERVED: Mapping[
    type[Section[Any] | JointKey[Any] | ServoKey[Any] | PolicyKey[Any] | PoseStage[Any]], str
] = {
    Section: f"{_REPORT} {_SECTIONS}",
    PoseStage: _REPORT,
    JointKey: f"{_REPORT} {_JOINTS}",
    ServoKey: f"{_REPORT} {_JOINTS}",
    PolicyKey: f"{_REPORT} exit_timeout of_joint on_exit on_fault on_returned_servo",
}
"""Names that a feature's key cannot have because the core uses them, by kind of key."""


def stages(kind: type[S], features: Iterable[Feature]) -> Iterator[tuple[Feature, S]]:
    """Yield each of the features that has a `STAGE` of this kind, with that object."""
    for feature in features:
        if (stage := feature.stage(kind)) is not None:
            yield feature, stage


def installed_features() -> tuple[Feature, ...]:
    """Return all features that a robot file can use: the built-in ones, then those of plug-ins by name."""
    return _installed(installed_plugins())[0]


def find_installed(features: Iterable[Feature]) -> tuple[Feature, ...]:
    """Return the installed features with the names of the given ones, as read from a log.

    The packages in a log are not imported, because a log may name any package.
    """
    names = {feature.name for feature in features}
    return tuple(feature for feature in installed_features() if feature.name in names)


def broken_features() -> dict[str, str]:
    """Return the reason why each unusable feature of a plug-in cannot be used, by the feature's name."""
    return _installed(installed_plugins())[1]


@cache
def _installed(plugins: tuple[InstalledPlugin, ...]) -> tuple[tuple[Feature, ...], dict[str, str]]:
    found = {feature.name: feature for feature in FEATURES}
    broken: dict[str, str] = {}
    for plugin in plugins:
        features: list[Feature] = []
        with suppress(Exception, SystemExit):  # foreign code: `dxlrun plugins` reports why it cannot be used
            features += _features_of(plugin)
        for feature in features:
            if fault := _find_fault(feature, found):
                broken[feature.name] = (
                    f"the key {feature.name} of {feature.distribution} cannot be used: {fault}; "
                    "report it to its author"
                )
            else:
                found[feature.name] = feature
    return tuple(found.values()), broken


def _find_fault(feature: Feature, found: Container[str]) -> str:
    """Return why a plug-in's feature is malformed or clashes with the others; empty if it is usable."""
    name = feature.name
    try:
        keys = [key for kind in RESERVED if (key := feature.stage(kind)) is not None]
        groups = [key.group for key in keys if isinstance(key, PolicyKey) and key.group is not None]
        for key in (*keys, *groups):
            _build_form(key.form)
    except (Exception, SystemExit) as error:
        return f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
    names = {key.name for key in (*keys, *groups)}
    faults = {
        "another feature has this name": name in found,
        "no STAGES, form.py, joint_key.py, servo_key.py, policy_key.py or pose_form.py declares it": name
        not in names,
        f"its files also declare {', '.join(sorted(names - {name}))}": len(names) > 1,
        "its name does not begin with a letter": name.startswith("_"),
        "dxlrun has a key with this name": any(name in RESERVED[type(key)].split() for key in keys),
        "it is declared both for joints and for servos": {JointKey, ServoKey} <= {*map(type, keys)},
    }
    return next((fault for fault, is_so in faults.items() if is_so), "")


def _build_form(form: object) -> None:
    """Build the validator of a plug-in's form; a wrong type raises before it spoils every robot file.

    In the form of the robot file, the wrong type would make every file unreadable.
    """
    # Imported here because most processes use no feature of a plug-in.
    from pydantic import TypeAdapter

    TypeAdapter(cast("type[object]", type_of(form))).rebuild()


def _features_of(plugin: InstalledPlugin) -> Iterator[Feature]:
    """Yield the features that a plug-in's function `dxlrun_features` returns; its exceptions pass through."""
    hook = getattr(plugin.point.load(), "dxlrun_features", None)
    for feature in () if hook is None else hook():
        yield replace(feature, distribution=plugin.publisher)
