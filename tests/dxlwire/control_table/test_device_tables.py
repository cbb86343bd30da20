"""Control tables of devices: their form, what a mistake in one is called, and what their values mean."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path

import pytest
from tests.kit.cases import TextCase, case_parameters, read_head

from dxlwire.control_table import device_models
from dxlwire.control_table.device_models import (
    add_device_table,
    device_table,
    device_tables,
    devices_by_number,
)
from dxlwire.control_table.device_table import read_device_table

TEXT = Path(__file__).with_name("device_mistakes.txt")
BOARD = read_head(TEXT)


@pytest.fixture(autouse=True)
def _no_added_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_models, "_ADDED", [])


def test_a_table_without_a_model_number_is_one_that_is_not_checked() -> None:
    table = read_device_table(BOARD.replace("model_number = 60_001\n", ""))
    assert table.model_number is None


@pytest.mark.parametrize("case", case_parameters(TEXT))
def test_a_mistake_is_named(case: TextCase) -> None:
    ((_, sentence, _),) = case.lines
    before, _, after = case.name.replace("\\n", "\n").partition(" => ")
    assert before in BOARD
    with pytest.raises(ValueError, match=re.escape(sentence)):
        read_device_table(BOARD.replace(before, after, 1))


NO_ALIAS = {'aliases = ["BOARD"]\n': ""}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"Board-1": "board", "60_001": "60_002"}, "a name of board is already used by the device Board-1"),
        ({"Board-1": "Board-2"} | NO_ALIAS, "number 60001 of Board-2 is already used by the device Board-1"),
        ({"Board-1": "AX12", "60_001": "60_002"} | NO_ALIAS, "AX12 is already the name of a servo model"),
        ({"Board-1": "Board-3", "60_001": "1020"} | NO_ALIAS, "is already used by the servo XM430-W350"),
    ],
)
def test_names_and_numbers_belong_to_one_model(changes: dict[str, str], sentence: str) -> None:
    add_device_table(BOARD)
    other = BOARD
    for before, after in changes.items():
        other = other.replace(before, after)
    with pytest.raises(ValueError, match=sentence):
        add_device_table(other)
    assert add_device_table(BOARD) is device_table("BOARD"), "a process may load its plug-ins twice"


def test_our_own_tables_are_whole() -> None:
    """Each has its source for every item, and no name or number twice."""
    tables = device_tables()
    assert len({table.model for table in tables}) == len(tables)
    for table in tables:
        others = [each for each in tables if each is not table]
        device_models._refuse_twins(table, others)
        assert table.cyclic, table.model
        states = [table.items[name].state for name in table.cyclic]
        assert len(set(states)) == len(states), table.model
        for item in table.items.values():
            assert item.page or table.model == "generic", (table.model, item.name)


def test_a_broken_text_is_no_table() -> None:
    with pytest.raises(tomllib.TOMLDecodeError):
        add_device_table("kind = ")
    with pytest.raises(ValueError, match="the entry 'items' is missing"):
        add_device_table('kind = "device"')


@pytest.mark.parametrize(
    ("model", "name", "raw", "value"),
    [
        ("CM-730", "gyro_x", 512, 0.0),
        ("CM-730", "gyro_x", 1023, math.radians(499.0234375)),
        ("CM-740", "acc_z", 640, 9.80665),
        ("CM-740", "present_voltage", 121, 12.1),
        ("OpenCR", "gyro_y", -16400, math.radians(-1000)),
        ("OpenCR", "acc_z", 16384, 9.80665),
        ("OpenCR", "yaw", -1800, -math.pi),
        ("bitbots-core", "vdxl", 776, 15.0046875),
        ("bitbots-core", "current", 776, (776 * 3.3 / 1024 - 2.5) / -0.066),
        ("bitbots-core", "current", 650, (650 * 3.3 / 1024 - 2.5) / -0.066),
        ("OP-FSR", "fsr_2", 9800, 9.8),
    ],
)
def test_units_are_those_of_the_sources(model: str, name: str, raw: int, value: float) -> None:
    """By the formulas of the documents: 512 of 1023 is rest, 16.4 ticks a degree per second."""
    item = device_table(model).items[name]
    assert item.value(item.encode(raw)) == pytest.approx(value, abs=1e-6)


def test_boards_are_found_by_name_and_by_number() -> None:
    for name in ("CM-730", "cm740", "OPEN-CR", "opencr", "BitFoot", "wolfgang core", "bitbots_imu"):
        assert device_table(name).model
    assert [each.model for each in devices_by_number(0x7400, 1.0)] == ["CM-740"]
    assert [each.model for each in devices_by_number(0x7400, 2.0)] == ["OpenCR"]
    assert devices_by_number(0, 2.0) == (), "the foot's number is none"
    with pytest.raises(LookupError, match=r"uses Protocol 1\.0, not Protocol 2\.0"):
        device_table("CM-730", 2.0)
