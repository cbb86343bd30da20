"""Features: one folder for each section of the robot file, with all that belongs to it.

A folder holds what one section needs in every stage, from its form to its part in the loop. What two features
share belongs to the room of that stage. `feature.py` describes the files; `FEATURES` names the folders.
"""

from __future__ import annotations

from collections.abc import Iterator

from dxlrun.features.feature import Feature, S

FEATURES = (
    Feature("devices", "dxlrun.features.devices"),
    Feature("sensors", "dxlrun.features.sensors"),
    Feature("mechanics", "dxlrun.features.mechanics"),
)
"""In the order in which every stage asks them; their states are in the cycle's record in this order."""


def stages(kind: type[S]) -> Iterator[tuple[Feature, S]]:
    """Yield the features that take part in a stage, each with its `STAGE`."""
    for feature in FEATURES:
        if (stage := feature.stage(kind)) is not None:
            yield feature, stage
