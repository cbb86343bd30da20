"""Control tables of devices: their form, what a mistake in one is called, and what their values mean."""

from __future__ import annotations

import math
import struct
import tomllib

import pytest

from dxlwire.control_table import device_models
from dxlwire.control_table.device_models import (
    add_device_table,
    device_table,
    device_tables,
    devices_by_number,
)
from dxlwire.control_table.device_table import read_device_table

BOARD = """\
kind = "device"
model = "Board-1"
aliases = ["BOARD"]
model_number = 60_001
protocol = 2.0
capabilities = ["sync_read"]
cyclic = ["pressure", "start", "stop", "yaw"]

[items]
model_number = {address = 0, size = 2, area = "EEPROM"}
lamp = {address = 20, size = 1, access = "RW", minimum = 0, maximum = 7, initial = 0, safe = 0}
start = {address = 30, size = 1, bit = 0, state = "button.start"}
stop = {address = 30, size = 1, bit = 3, state = "button.stop"}
pressure = {address = 31, size = 2, tick = "-0.1 mN", offset = "2 N", state = "force.z"}
yaw = {address = 36, size = 4, encoding = "float32", tick = "1 rad", state = "orientation.z"}
"""


@pytest.fixture(autouse=True)
def _no_added_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_models, "_ADDED", [])


def test_items_have_units_offsets_bits_and_floats() -> None:
    items = read_device_table(BOARD).items
    assert items["pressure"].value((300).to_bytes(2, "little")) == pytest.approx(2.0 - 0.03)
    assert [items[name].value(bytes((0b1001,))) for name in ("start", "stop")] == [1.0, 1.0]
    assert [items[name].value(bytes((0b0110,))) for name in ("start", "stop")] == [0.0, 0.0]
    assert [items[name].value(bytes((0b1000,))) for name in ("start", "stop")] == [0.0, 1.0]
    assert items["yaw"].value(struct.pack("<f", -1.25)) == -1.25
    assert [item.state for item in items.values()][4:] == [
        "button.start",
        "button.stop",
        "force.z",
        "orientation.z",
    ]


def test_a_table_without_a_model_number_is_one_that_is_not_checked() -> None:
    table = read_device_table(BOARD.replace("model_number = 60_001\n", ""))
    assert table.model_number is None


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        ('kind = "device"\n', "", 'kind must be "device"'),
        ("protocol = 2.0", "protocol = 2", "protocol must be 1.0 or 2.0, not 2"),
        ('["sync_read"]', '["sync_raed"]', "capabilities not allowed for a device: sync_raed"),
        ('["pressure", ', '["presure", ', "cyclic: unknown item presure"),
        ("address = 31", "address = 30", "pressure: address 30 overlaps st"),
        ("bit = 3", "bit = 0", "bit 0 of address 30 is defined twice"),
        ("bit = 3", "bit = 8", "stop: the bit must be 0..7, not 8"),
        ("size = 1, bit = 3", 'size = 1, access = "RW", bit = 3', "stop: a bit must be unsigned, read-only"),
        (
            'tick = "-0.1 mN"',
            'tick = "0.1 lbf"',
            "pressure: tick: '0.1 lbf': the unit is not one of rad, deg",
        ),
        ('"-0.1 mN"', '"0 mN"', "pressure: the tick must not be 0"),
        ('offset = "2 N"', 'offset = "2 V"', "pressure: offset and tick have different units, V and N"),
        (
            "address = 36, size = 4",
            "address = 36, size = 2",
            "yaw: the size must be 1, 2 or 4 (float32: 4), not 2",
        ),
        ("address = 36, ", "", "yaw: missing required field `address`"),
        ("address = 36", "adress = 36, address = 36", "yaw: keys not allowed in an item of a device: adress"),
        ("address = 36", 'address = "36"', "yaw: address: Expected `int`, got `str`"),
        ("safe = 0", "safe = 8", "lamp: the safe value 8 is outside its range"),
        ("initial = 0", "initial = 9", "lamp: the initial value 9 is outside its range"),
        ("maximum = 7", "maximum = 256", "lamp: 0..256 does not fit into its bytes"),
        ('access = "RW"', 'access = "R"', "lamp: a safe value needs a writable item in RAM"),
        ('"force.z"', '"force z"', "pressure: 'force z' is not a state name (letters"),
        ('"force.z"', '"age"', "pressure: the state name `age` is reserved"),
        ("protocol = 2.0", "protocol = [2.0]", "protocol must be 1.0 or 2.0, not [2.0]"),
        ('"-0.1 mN"', '"1/0 mN"', "pressure: tick: '1/0 mN' divides by 0"),
        ('"2 N"', '"inf N"', "pressure: offset: 'inf N' is not a finite number"),
        ('tick = "1 rad"', "maximum = 1", "yaw: a float32 cannot have minimum and maximum"),
        ('tick = "1 rad"', "initial = 1", "yaw: initial and safe value of a float32 must be 0"),
        ("{address = 0, size = 2", "{address = 4, size = 2", "a checked model number must be at address 0"),
    ],
)
def test_a_mistake_is_named(before: str, after: str, sentence: str) -> None:
    assert before in BOARD
    with pytest.raises(ValueError) as error:  # noqa: PT011  # the sentence is what is compared
        read_device_table(BOARD.replace(before, after, 1))
    assert sentence in str(error.value)


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        ('"Board-1"', '"board"', "a name of board is already used by the device Board-1"),
        ("60_001", "60_001 # Board-2", "model number 60001 of Board-2 is already used by the device Board-1"),
        ('"Board-1"', '"AX12"', "AX12 is already the name of a servo model"),
        ("60_001", "1020", "is already used by the servo XM430-W350"),
    ],
)
def test_names_and_numbers_belong_to_one_model(before: str, after: str, sentence: str) -> None:
    add_device_table(BOARD)
    other = BOARD.replace(before, after)
    if "# Board-2" in other:
        other = other.replace('"Board-1"', '"Board-2"')
    if "# Board-2" not in other and "1020" not in other:
        other = other.replace("60_001", "60_002")
    if '"board"' not in other:
        other = other.replace('aliases = ["BOARD"]\n', "")
    if "1020" in other:
        other = other.replace('"Board-1"', '"Board-3"')
    with pytest.raises(ValueError, match="already") as error:
        add_device_table(other)
    assert sentence in str(error.value)
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
