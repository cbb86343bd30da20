"""Lines of simulated servos on virtual time, for tests of the library alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.kit.simulated_line import Line, Line2, build_line


@pytest.fixture
def make_line() -> Callable[..., Line]:
    def make(ids: tuple[int, ...] = (1, 2), model: str = "AX-12A", **settings: Any) -> Line:
        return build_line(Line, 1.0, ids, model, **settings)

    return make


@pytest.fixture
def make_line2() -> Callable[..., Line]:
    def make(ids: tuple[int, ...] = (1, 2), model: str = "XM430-W350", **settings: Any) -> Line:
        return build_line(Line2, 2.0, ids, model, **settings)

    return make


@pytest.fixture
def line_of(make_line: Callable[..., Line], make_line2: Callable[..., Line]) -> Callable[..., Line]:
    """Return a line of Protocol 1 or 2."""
    return lambda protocol, *ids_and_model, **settings: (make_line if protocol == 1 else make_line2)(
        *ids_and_model, **settings
    )


@pytest.fixture(params=[1, 2])
def both(request: Any, line_of: Callable[..., Line]) -> Line:
    """A line of each protocol."""
    return line_of(request.param)


@pytest.fixture
def line2(make_line2: Callable[..., Line]) -> Line:
    return make_line2()


@pytest.fixture
def line(make_line: Callable[..., Line]) -> Line:
    return make_line()
