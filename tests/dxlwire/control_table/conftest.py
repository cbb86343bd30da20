from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import dxlwire.control_table
from dxlwire.control_table import ControlTable

TABLES = Path(dxlwire.control_table.__file__).parent / "tables"


@pytest.fixture
def places() -> Callable[[ControlTable], dict[str, tuple[int, int, bool]]]:
    """Item -> address, size, writable."""
    return lambda table: {
        name: (item.address, item.size, item.access == "RW") for name, item in table.items.items()
    }


@pytest.fixture
def data_files() -> Path:
    return TABLES
