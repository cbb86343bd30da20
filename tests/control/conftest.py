"""A robot of a few joints without servos, whose controllers are written in the tests."""

import pytest
from tests.kit.loops import Robot


@pytest.fixture
def robot():
    return Robot()
