from __future__ import annotations

import importlib.util
import math
import re
import subprocess
import sys
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
import rustypot

from dxlwire.control_table import ControlTable, all_tables, find_table, models_by_number

PRO = {
    "L42-10-S300-R": 35072,
    "L54-30-S400-R": 37928,
    "L54-30-S500-R": 37896,
    "L54-50-S290-R": 38176,
    "L54-50-S500-R": 38152,
    "M42-10-S260-R": 43288,
    "M54-40-S250-R": 46096,
    "M54-60-S250-R": 46352,
    "H42-20-S300-R": 51200,
    "H54-100-S500-R": 53768,
    "H54-200-S500-R": 54024,
    "RH-P12-RN": 35073,
}
"""PRO before (A) and the first gripper; numbers: e-Manual, dynamixel-workbench 2eb370f, dynamixel_item.h."""
OWN = {"XM335-T323": 1710, "XC335-T332": 1700} | PRO
"""Models of Protocol 2.0 that the SDK has no file of; numbers: e-Manual, dynamixel_hardware_interface."""
Places = Callable[[ControlTable], dict[str, tuple[int, int, bool]]]
OTHER_NAMES = {"baudrate": "baud_rate"}
ONLY_HERE = {
    "MX-106": {"drive_mode", "current", "torque_ctrl_mode_enable", "goal_torque"},
    "MX-64": {"current", "torque_ctrl_mode_enable", "goal_torque"},
}
"""Items of the manual that the foreign list of all MX does not have."""


def _foreign(controller: Any) -> dict[str, tuple[int, int, bool]]:
    return {
        OTHER_NAMES.get(each.name, each.name): (
            each.addr,
            each.size,
            each.access == rustypot.RegisterAccess.ReadWrite,
        )
        for each in controller.registers()
    }


@pytest.mark.parametrize(
    "model", ["AX-12A", "AX-12W", "AX-18A", "RX-24F", "RX-28", "RX-64", "DX-113", "DX-117"]
)
def test_ax_rx_and_dx_stand_where_a_foreign_list_has_them(model: str, places: Places) -> None:
    assert places(find_table(model)) == _foreign(rustypot.AxPyController)


@pytest.mark.parametrize("model", ["MX-12W", "MX-28", "MX-64", "MX-106"])
def test_mx_stands_where_a_foreign_list_has_it(model: str, places: Places) -> None:
    ours = places(find_table(model, 1.0))
    foreign = _foreign(rustypot.MxPyController)
    assert foreign.items() <= ours.items()
    assert ours.keys() - foreign.keys() == ONLY_HERE.get(model, set())


def test_xl_320_stands_where_a_foreign_list_has_it(places: Places) -> None:
    foreign = _foreign(rustypot.Xl320PyController)
    foreign["registered_instruction"] = foreign.pop("registered")  # the name in the manual's table
    assert places(find_table("XL-320")) == foreign


def test_x430_stands_where_a_foreign_list_has_it(places: Places) -> None:
    ours = places(find_table("XM430-W350"))
    foreign = _foreign(rustypot.Xl430PyController)
    foreign["secondary_shadow_id"] = foreign.pop("secondary_id")
    common = foreign.keys() & ours.keys()
    assert {name: ours[name] for name in common} == {name: foreign[name] for name in common}
    assert len(common) > 50
    assert foreign.keys() <= ours.keys()


@pytest.mark.parametrize(
    "controller", [rustypot.AxPyController, rustypot.MxPyController, rustypot.Xl430PyController]
)
def test_model_numbers_are_those_of_a_foreign_list(controller: Any) -> None:
    protocol = 2.0 if controller is rustypot.Xl430PyController else 1.0
    for name, number in controller.models().items():
        (table,) = models_by_number(number, protocol)
        wanted = {"AX12": "AX12A", "XL430W2502": "2XL430W250"}.get(name, name)
        assert table.model.replace("-", "") == wanted


def sdk_files() -> tuple[Path, ...]:
    """Return the data files of dynamixel-sdk, one a model; its __init__, with all of its code, is not run."""
    found = importlib.util.find_spec("dynamixel_easy_sdk")
    assert found is not None
    assert found.submodule_search_locations
    folder = Path(found.submodule_search_locations[0]) / "control_table"
    return tuple(path for path in sorted(folder.glob("*.model")) if path.name != "dynamixel.model")


def _sdk_rows(path: Path) -> dict[str, tuple[int, int]]:
    rows = path.read_text("utf-8").split("[control table]")[1].strip().splitlines()[1:]
    split = [row.split("\t") for row in rows]
    return {name.strip(): (int(address), int(size)) for address, size, name in split}


def test_every_model_of_the_sdk_is_there() -> None:
    files = sdk_files()
    assert len(files) == 67
    sdk = [table for table in all_tables() if table.protocol == 2.0 and table.model not in OWN]
    assert len(sdk) == len(files)


def test_models_that_the_sdk_lacks_are_there_by_name_and_number() -> None:
    for model, number in OWN.items():
        (table,) = models_by_number(number, 2.0)
        assert table is find_table(model)
        assert table.model == model
        assert f"{number}\t" not in (sdk_files()[0].parent / "dynamixel.model").read_text("utf-8")


@pytest.mark.parametrize("model", PRO)
def test_pro_stands_where_the_maker_s_examples_address_it(model: str, places: Places) -> None:
    # DynamixelSDK 2ded684d, c++/example/protocol2.0: read_write.cpp (PRO_SERIES), indirect_address.cpp;
    # Dynamixel2Arduino, actuator.cpp, pro_r_control_table
    ours = places(find_table(model))
    assert {name: ours[name][0] for name in ("torque_enable", "led_red", "goal_position", "moving")} == {
        "torque_enable": 562,
        "led_red": 563,
        "goal_position": 596,
        "moving": 610,
    }
    assert ours["present_position"] == (611, 4, False)
    assert (ours["present_velocity"][0], ours["present_current"][:2]) == (615, (621, 2))
    assert [ours[name][0] for name in ("indirect_address_1", "indirect_address_256")] == [49, 559]
    assert [ours[name][0] for name in ("indirect_data_1", "indirect_data_256")] == [634, 889]
    assert ours["goal_torque"][:2] == (604, 2)


@pytest.mark.parametrize("model", sorted(PRO.keys() - {"L42-10-S300-R", "RH-P12-RN"}))
def test_pro_counts_its_speed_in_turns_of_the_motor_a_minute(model: str) -> None:
    # e-Manual, Goal Velocity(600): 1 is one turn a minute before the gear; Specifications, Gear Ratio
    table = find_table(model)
    for name in ("goal_velocity", "present_velocity", "velocity_limit", "moving_threshold"):
        assert table.items[name].scale == pytest.approx(math.tau / 60 / table.gear_ratio, rel=3e-4), name


@pytest.mark.parametrize(
    ("model", "same"),
    [
        ("XC430-T150BB", "XC430-W150"),
        ("XC430-W150BB", "XC430-W150"),
        ("XC430-T240BB", "XC430-W240"),
        ("XC430-W240BB", "XC430-W240"),
    ],
)
def test_a_model_with_ball_bearings_is_the_one_without(model: str, same: str) -> None:
    assert find_table(model) is find_table(same)


@pytest.mark.parametrize(
    ("patterns", "ends"),
    [
        (("x?430_*", "x?540_*", "2x*", "mx_*"), (1, 2)),
        (("x?330_*",), (2, 22)),
        (("p[hm]*", "*_ra", "rh_p12_rn"), (2, 10)),
        (("ym*",), (2, 2)),
    ],
)
def test_the_range_of_protocol_type_is_that_of_the_series(
    patterns: tuple[str, ...], ends: tuple[int, int]
) -> None:
    # e-Manual, Protocol Type(13): "1 ~ 2" for X430, X540 and MX(2.0), "2 ~ 22" for X330 and X335
    found = [_table_of(path).items.get("protocol_type") for path in _files(patterns)]
    assert {(item.minimum, item.maximum) for item in found if item is not None} == {ends}


def test_every_number_of_the_sdk_leads_to_a_table_with_its_cells() -> None:
    folder = sdk_files()[0].parent
    lines = (folder / "dynamixel.model").read_text("utf-8").splitlines()[1:]
    for line in lines:
        number, name = line.split("\t")
        older = models_by_number(int(number), 2.0)[-1]  # the file without a firmware in its name
        cells = {(item.address, item.size) for item in older.items.values()}
        assert set(_sdk_rows(folder / name.strip()).values()) <= cells, name


X430_X540 = ("2x*", "x[lc]430_*", "x[mh]430_*", "x[mh]540_*", "xw430_*", "xw540_t*")
"""SDK files of the models of items_XL, _XM, _EXTXM, _XH, _EXTXH and _XW."""
OMITTED = [
    # SDK files; address, size; the item's name here; the firmware that brought it
    # dynamixel-workbench 2eb370f, dynamixel_item.cpp, items_XL to items_XW; e-Manual, X430 and X540, Startup
    # Configuration(60) and Backup Ready(147): "available from firmware V45"
    (X430_X540, 21, 60, 1, "startup_configuration", 45),
    (X430_X540, 21, 147, 1, "backup_ready", 45),
    # not in dynamixel-workbench; the same sections of the e-Manual
    (("xd*", "xw540_h*"), 5, 60, 1, "startup_configuration", 45),
    (("xd*", "xw540_h*"), 5, 147, 1, "backup_ready", 45),
    # items_X330; e-Manual, XL330 and XC330: "available from firmware V46"
    (("x[lc]330_*",), 12, 60, 1, "startup_configuration", 46),
    (("x[lc]330_*",), 12, 147, 1, "backup_ready", 46),
    # items_EXTGripper
    (("rh_p12_rn",), 1, 10, 1, "drive_mode", 0),
    (("rh_p12_rn",), 1, 600, 2, "external_port_data_1", 0),
    (("rh_p12_rn",), 1, 602, 2, "external_port_data_2", 0),
    (("rh_p12_rn",), 1, 604, 2, "external_port_data_3", 0),
    (("rh_p12_rn",), 1, 606, 2, "external_port_data_4", 0),
]
"""What the maker's other sources list and the SDK's files leave out, with the number of those files."""


def _files(patterns: tuple[str, ...]) -> list[Path]:
    return [path for path in sdk_files() if any(fnmatch(path.stem, pattern) for pattern in patterns)]


def _table_of(path: Path) -> ControlTable:
    """Return the table of an SDK file; of two by firmware, the newer one has the plain name."""
    name = re.sub("-RA$", "-R(A)", path.stem.removesuffix("_fw52").upper().replace("_", "-"))
    if path.stem.endswith("_fw52") or not path.with_name(f"{path.stem}_fw52.model").exists():
        return find_table({"RH-P12-RN": "RH-P12-RN(A)", "XL320": "XL-320"}.get(name, name), 2.0)
    return find_table(f"{name}-FW51", 2.0)


@pytest.mark.parametrize("fact", OMITTED)
def test_what_the_sdk_omits_and_the_maker_lists_elsewhere_is_there(
    fact: tuple[tuple[str, ...], int, int, int, str, int],
) -> None:
    patterns, count, address, size, name, firmware = fact
    files = _files(patterns)
    assert len(files) == count
    for path in files:
        assert (address, size) not in _sdk_rows(path).values(), f"{path.stem} has it by now"
        table = _table_of(path)
        item = table.items[name]
        assert (item.address, item.size, item.firmware) == (address, size, firmware), path.stem
        assert name in table.with_firmware(firmware).items
        assert name not in table.with_firmware(firmware - 1).items


NOT_TAKEN_OVER = [
    # Acceleration Limit: the newer pages of these models in the e-Manual have it no more
    (X430_X540, 40),
    # a misprint: the e-Manual, and so the SDK, have Torque Limit of the XL-320 at 35
    (("xl320",), 34),
]
"""What dynamixel-workbench lists and no table here has, by the address."""


@pytest.mark.parametrize(("patterns", "address"), NOT_TAKEN_OVER)
def test_what_the_manual_does_not_confirm_is_not_taken_over(patterns: tuple[str, ...], address: int) -> None:
    for path in _files(patterns):
        assert address not in {item.address for item in _table_of(path).items.values()}


@pytest.mark.parametrize("model", ["MX-28", "MX-64", "MX-106"])
def test_mx_of_protocol_2_has_no_startup_configuration_in_any_source(model: str) -> None:
    # e-Manual, MX-28(2.0) to MX-106(2.0); dynamixel-workbench, items_MX2 and items_EXTMX2; the SDK's files
    assert not {"startup_configuration", "backup_ready"} & find_table(model, 2.0).items.keys()


def test_the_sdk_is_still_wrong_about_what_we_correct() -> None:
    folder = sdk_files()[0].parent
    assert "value_of_max_radian_position\t4095" in (folder / "xl320.model").read_text("utf-8")
    assert "value_of_min_radian_position\t0" in (folder / "xm430_w350.model").read_text("utf-8")
    assert "262144" in (folder / "ym070_210_r051.model").read_text("utf-8")
    assert "xw430_t200" not in (folder / "dynamixel.model").read_text("utf-8")


def test_tables_are_read_without_importing_anything_heavy() -> None:
    code = (
        "import sys; from dxlwire.control_table import all_tables; assert len(all_tables()) > 60;"
        "heavy = {'numpy', 'pydantic', 'yaml', 'serial', 'dynamixel_sdk'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
