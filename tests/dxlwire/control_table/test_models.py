"""Names and numbers of models, tables of servos and devices from files, and mistakes in them."""

import math
import re
import tomllib
from pathlib import Path

import pytest
from tests.kit.cases import TextCase, case_parameters, read_head

import dxlwire.control_table
from dxlwire.control_table import (
    ControlItem,
    add_control_table,
    decoded,
    device_models,
    find_table,
    model_names,
    models_by_number,
    read_control_table,
    servo_models,
)
from dxlwire.control_table.device_models import (
    add_device_table,
    device_table,
    device_tables,
    devices_by_number,
)
from dxlwire.control_table.device_table import read_device_table
from dxlwire.control_table.table_files import resolve

AX_TEXT = (Path(dxlwire.control_table.__file__).parent / "tables/protocol1/AX-12A.toml").read_text("utf-8")


@pytest.fixture
def mine(monkeypatch: pytest.MonkeyPatch) -> str:
    """The table of a servo that a plug-in brings along; it is forgotten after the test."""
    monkeypatch.setattr(servo_models, "_ADDED", {1.0: [], 2.0: []})
    text = AX_TEXT
    for old, new in (
        ('model = "AX-12A"', 'model = "Mine-1"'),
        ('aliases = ["AX-12", "AX-12+"]', "aliases = []"),
        ("model_number = 12\n", "model_number = 60001\n"),
    ):
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("AX-12", "AX-12A"),
        ("AX-12+", "AX-12A"),
        ("XL-430", "XL430-W250"),
        ("xl430", "XL430-W250"),
        ("XL430-W250-T", "XL430-W250"),
        ("XM540-W270-R", "XM540-W270"),
        ("2XC430", "2XC430-W250"),
        ("AX12", "AX-12A"),
        ("ax 12a", "AX-12A"),
        ("XL_320", "XL-320"),
        ("EX-106", "EX-106+"),
        ("MX64AT", "MX-64"),
        ("XC330-M288-T", "XC330-M288"),
        # with ball bearings
        ("XC430-T150BB", "XC430-W150"),
        ("XC430-W150BB", "XC430-W150"),
        ("XC430-T240BB", "XC430-W240"),
        ("XC430-W240BB", "XC430-W240"),
    ],
)
def test_names_that_mean_one_model_are_understood(name: str, model: str) -> None:
    assert find_table(name).model == model


@pytest.mark.parametrize(
    "name", ["XM430", "XL330", "XL", "XL-3", "AX", "AX-13", "XL430-W250-B", "T", "-", ""]
)
def test_names_that_mean_several_models_or_none_are_not(name: str) -> None:
    with pytest.raises(LookupError, match="no control table for the model"):
        find_table(name)


def test_a_model_of_both_protocols_is_chosen_by_the_protocol() -> None:
    assert find_table("MX-28", 1.0).model_number == 29
    assert find_table("MX-28", 2.0).model_number == 30
    assert find_table("MX-28(2.0)").model_number == 30
    with pytest.raises(LookupError, match=r"Protocol 1\.0 and 2\.0; give the protocol"):
        find_table("MX-28")
    with pytest.raises(LookupError, match=r"AX-12A uses Protocol 1\.0, not Protocol 2\.0"):
        find_table("AX-12A", 2.0)
    with pytest.raises(LookupError, match="'AX-13'; `dxlrun models` lists all"):
        find_table("AX-13", 1.0)


def test_a_table_of_a_plug_in_is_found_by_name_and_number(mine: str) -> None:
    table = add_control_table(mine)
    assert find_table("Mine-1") is table
    assert models_by_number(60001, 1.0) == (table,)
    assert "Mine-1" in model_names()
    assert add_control_table(mine) == table, "the same table twice is no contradiction"


LOAD = 'tick = "{}", page = "Present Load'


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('model = "Mine-1"', 'model = "AX-12+"', "is already used by the AX-12A"),
        ("model_number = 60001\n", "model_number = 12\n", "is already used by the AX-12A"),
        ("model_number = 60001\n", "", "the entry 'model_number' is missing"),
        ("protocol = 1.0\n", "protocol = 3.0\n", "protocol must be 1.0 or 2.0, not 3.0"),
        ('["sync_write"]', '["telepathy"]', "not allowed in a data file: telepathy"),
        (
            LOAD.format("1/1023 fraction"),
            LOAD.format("1 V"),
            "load: the unit must be a fraction, A or Nm, not V",
        ),
    ],
)
def test_a_table_of_a_plug_in_that_cannot_be_used_is_refused(
    mine: str, old: str, new: str, complaint: str
) -> None:
    assert old in mine
    with pytest.raises(ValueError, match=complaint):
        add_control_table(mine.replace(old, new))


def test_a_file_takes_over_what_it_does_not_say() -> None:
    entries = {
        "a": {
            "model": "A",
            "aliases": ["A-T"],
            "speed": 1,
            "items": {"x": {"address": 4, "size": 1}, "y": {"address": 6, "size": 1}},
        },
        "b": {
            "extends": "a",
            "model": "B",
            "left_out": ["y"],
            "items": {"x": {"size": 2}, "z": {"address": 0}},
        },
    }
    merged = resolve("b", entries)
    assert (merged["model"], merged["aliases"], merged["speed"]) == ("B", [], 1)
    assert merged["items"] == {"z": {"address": 0}, "x": {"address": 4, "size": 2}}
    assert list(merged["items"]) == ["z", "x"], "in the order of addresses"
    assert entries["a"]["items"] == {"x": {"address": 4, "size": 1}, "y": {"address": 6, "size": 1}}


@pytest.mark.parametrize("entries", [{"a": {"extends": "b"}}, {"a": {"extends": "b"}, "b": {"extends": "a"}}])
def test_a_file_that_extends_nothing_or_itself_is_refused(entries: dict[str, dict[str, str]]) -> None:
    with pytest.raises(ValueError, match="is not another control table"):
        resolve("a", entries)


AX = find_table("AX-12A")


def test_units_are_exact_and_not_the_rounded_ones_of_the_manual() -> None:
    assert math.degrees(AX.rad_per_tick) == pytest.approx(300 / 1023, rel=1e-15)
    assert math.degrees(AX.rad_per_tick * AX.max_tick) == pytest.approx(300, rel=1e-15)
    assert AX.rad_s_per_tick == pytest.approx(0.111 * 2 * math.pi / 60, rel=1e-15)
    assert AX.max_speed == pytest.approx(59 * 2 * math.pi / 60, rel=1e-15)
    rpm = AX.max_speed_tick * AX.rad_s_per_tick * 60 / (2 * math.pi)
    assert round(rpm) == 114  # e-Manual, Moving Speed (32): "If it is 1023, it is about 114rpm"
    assert AX.effort_per_tick == 1 / 1023
    units = {
        "present_voltage": ("V", 0.1),
        "present_temperature": ("degC", 1.0),
        "return_delay_time": ("s", 2e-6),
        "goal_position": ("rad", AX.rad_per_tick),
        "torque_enable": ("", 1.0),
    }
    assert {name: (AX.items[name].unit, AX.items[name].scale) for name in units} == units


def test_a_zero_with_direction_is_zero() -> None:
    assert AX.items["present_load"].decode(b"\x00\x04") == 0  # e-Manual: "1024 is equal to 0"


@pytest.mark.parametrize(("name", "ticks"), [("goal_position", -1), ("id", 256), ("present_speed", 1024)])
def test_a_value_that_does_not_fit_is_refused_by_name(name: str, ticks: int) -> None:
    with pytest.raises(ValueError, match=name):
        AX.items[name].encode(ticks)


def test_only_items_that_lie_whole_in_the_bytes_are_decoded() -> None:
    items = find_table("XM430-W350", 2.0).items
    assert decoded(items.values(), 80, b"\1\0\2\0\3") == {"position_d_gain": 1, "position_i_gain": 2}
    assert decoded([items["position_d_gain"]], 81, b"\0\0\0") == {}


def test_a_reply_of_the_wrong_length_is_refused() -> None:
    with pytest.raises(ValueError, match="2 bytes are needed, 1 were given"):
        AX.items["goal_position"].decode(b"\x00")


def test_items_of_devices_have_integers_bytes_and_values() -> None:
    meters = "sign_magnitude", "m", 0.5, ""
    signed = ControlItem("x", 0, 2, "RW", "RAM", -1023, 1023, None, *meters, offset=3.0)
    assert signed.wire_bytes(-5) == b"\x05\x04"
    assert (signed.integer(b"\x05\x04"), signed.value(b"\x05\x04")) == (-5, 0.5)
    button = ControlItem("b", 0, 1, "R", "RAM", 0, 255, None, "unsigned", "", 1.0, "", bit=2)
    assert [(button.integer(data), button.value(data)) for data in (b"\x04", b"\xfb")] == [(1, 1.0), (0, 0.0)]
    real = ControlItem("f", 0, 4, "RW", "RAM", 0, 2**32 - 1, None, "float32", "m", 2.0, "")
    assert (real.integer(b"\0\0\x80\x3e"), real.value(b"\0\0\x80\x3e")) == (0x3E800000, 0.5)


TEXT = Path(__file__).with_name("device_mistakes.txt")
BOARD = read_head(TEXT)


@pytest.fixture(autouse=True)
def _no_added_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_models, "_ADDED", [])


def test_a_table_without_a_model_number_is_one_that_is_not_checked() -> None:
    table = read_device_table(BOARD.replace("model_number = 60_001\n", ""))
    assert table.model_number is None


@pytest.mark.parametrize("case", case_parameters(TEXT, TEXT.with_name("servo_mistakes.txt")))
def test_a_mistake_is_named(case: TextCase) -> None:
    ((_, sentence, _),) = case.lines
    before, _, after = case.name.replace("\\n", "\n").partition(" => ")
    right, read = (BOARD, read_device_table) if case.file == TEXT else (AX_TEXT, read_control_table)
    assert before in right
    with pytest.raises(ValueError, match=re.escape(sentence)):
        read(right.replace(before, after, 1))


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
