"""Pytest fixture `dynamixel_bus`: a simulated bus on a pseudo-terminal, for tests of any program.

A project enables it in its `conftest.py`:

    pytest_plugins = ["dxlsim.pytest_plugin"]

It is not an entry point: pytest would import it in each run of every project of the environment, and rewrite
the assertions in all modules of the distribution.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from dxlsim.serving.served_bus import ServedBus, serve_bus

SERVOS = "XL430-W250:1,2"
"""Servos of the fixture `dynamixel_bus` in a test without the mark of this name."""


def pytest_configure(config: pytest.Config) -> None:
    """Register the mark `dynamixel_bus` with pytest."""
    config.addinivalue_line(
        "markers",
        "dynamixel_bus(*servos, baud_rate, protocol, faults, seed, link): the servos of the fixture "
        "dynamixel_bus, as in `dxlsim.serve_bus`",
    )


@pytest.fixture
def dynamixel_bus(request: pytest.FixtureRequest) -> Iterator[ServedBus]:
    """Serve simulated Dynamixel servos on a pseudo-terminal: XL430-W250 with IDs 1 and 2.

    `@pytest.mark.dynamixel_bus("AX-12A:1-6", faults=["silence servo=3"])` selects other servos.
    """
    mark = request.node.get_closest_marker("dynamixel_bus")
    with serve_bus(*(mark.args or (SERVOS,)), **mark.kwargs) if mark else serve_bus(SERVOS) as bus:
        yield bus
