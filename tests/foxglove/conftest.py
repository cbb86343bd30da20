"""Servers of viewers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from tests.foxglove.served import Served


@pytest.fixture
def serve():
    from tests.foxglove.served import Served  # needs the extra

    served: list[Served] = []

    def make(name: str = "bioloid_torso_imu", **options: Any) -> Served:
        served.append(Served(name, **options))
        return served[-1]

    yield make
    for one in served:
        one.close()
