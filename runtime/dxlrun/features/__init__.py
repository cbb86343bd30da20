"""Features: one folder for each section or key of the robot file, with all that belongs to it.

A folder holds what one feature needs in every stage, from its form to its part in the loop. What two features
share belongs to the room of that stage. `feature.py` describes the files; `FEATURES` names the folders.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache

from msgspec.structs import replace

from dxlrun.features.feature import Feature, JointKey, PolicyKey, S, Section, ServoKey
from dxlrun.installed_plugins import InstalledPlugin, installed_plugins

FEATURES = (
    Feature("devices", "dxlrun.features.devices"),
    Feature("on_lost_servo", "dxlrun.features.lost_servos"),
    Feature("on_stale_command", "dxlrun.features.stale_commands"),
    Feature("sensors", "dxlrun.features.sensors"),
    Feature("transmissions", "dxlrun.features.mechanics"),
    Feature("registers", "dxlrun.features.registers"),
    Feature("recording", "dxlrun.features.recording"),
)
"""In the order in which every stage asks them; their states are in the cycle's record in this order.

Devices are the first, because their plans count columns of the record from 0.
"""


def stages(kind: type[S], features: Iterable[Feature]) -> Iterator[tuple[Feature, S]]:
    """Yield the features that take part in a stage, each with its `STAGE`."""
    for feature in features:
        if (stage := feature.stage(kind)) is not None:
            yield feature, stage


def installed_features() -> tuple[Feature, ...]:
    """Return all features that a robot file may have: ours, then those of plug-ins by name."""
    return _installed(installed_plugins())[0]


def find_installed(features: Iterable[Feature]) -> tuple[Feature, ...]:
    """Return the installed features with the names of these: a log may name any package to import."""
    names = {feature.name for feature in features}
    return tuple(feature for feature in installed_features() if feature.name in names)


def broken_features() -> dict[str, str]:
    """Return the features of plug-ins that cannot be used, with the reason, by name."""
    return _installed(installed_plugins())[1]


@cache
def _installed(plugins: tuple[InstalledPlugin, ...]) -> tuple[tuple[Feature, ...], dict[str, str]]:
    found = {feature.name: feature for feature in FEATURES}
    broken: dict[str, str] = {}
    for plugin in plugins:
        features: list[Feature] = []
        with suppress(Exception, SystemExit):  # foreign code: `dxlrun plugins` says why it cannot be used
            features += _features_of(plugin)
        for feature in features:
            try:
                forms = feature.stage(Section), feature.stage(PolicyKey)
                keys = *forms, feature.stage(JointKey), feature.stage(ServoKey)
            except (Exception, SystemExit) as error:
                broken[feature.name] = (
                    f"the section {feature.name} of {feature.distribution} cannot be used "
                    f"({type(error).__name__}: {error}); report it to its author"
                )
                continue
            if feature.name not in {key.name for key in keys if key} or feature.name in found:
                broken[feature.name] = (
                    f"{feature.distribution} offers the section {feature.name}, which "
                    + ("is there already" if feature.name in found else "its form.py does not have")
                    + "; report it to its author"
                )
                continue
            found[feature.name] = feature
    return tuple(found.values()), broken


def _features_of(plugin: InstalledPlugin) -> Iterator[Feature]:
    """Yield the features of one plug-in; raises whatever its code raises."""
    hook = getattr(plugin.point.load(), "dxlrun_features", None)
    for feature in () if hook is None else hook():
        yield replace(feature, distribution=plugin.publisher)
